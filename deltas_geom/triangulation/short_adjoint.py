"""The gradient of the short way's points: `adjoint`, from rows and eigenvectors."""

import numpy as np

from deltas_geom.numerics.vectors import Array
from deltas_geom.triangulation.adjoint import through_centers, through_frame
from deltas_geom.triangulation.short import ShortRig, Solved


def gradients(
    rig: ShortRig, solved: Solved, gradient: Array, *, fixed: bool, of_cameras: bool
) -> tuple[Array | None, Array, Array]:
    """As :func:`gradients_of`, but by the size of weights, with a gradient ``(*B, N, 3)``.

    ``fixed``: were the points solved in the world's frame?
    """
    with np.errstate(all="ignore"):
        valid = solved.status == 0
        x = np.where(valid[..., None], solved.vectors[..., 0], (0.0, 0.0, 0.0, 1.0))
        push, mu = _pushed(solved, x, np.where(valid[..., None], gradient, 0.0), valid)
        error, pushed = (solved.equations @ v[..., None, :, None] for v in (x, push))
        error, pushed = error[..., 0], pushed[..., 0]  # (*B, N, V, 2)
        depth, deep = ((solved.cameras[..., 2, :] @ v[..., None])[..., 0] for v in (x, push))
        squared = solved.share * solved.share
        by_pixel = deep[..., None] * error + depth[..., None] * pushed
        by_pixel = -squared[..., None] * by_pixel
        total = np.maximum(squared.sum(axis=-1), 1.0)
        place, y, origin = (
            [v[..., k] for k in range(v.shape[-1])] for v in (x, push, solved.origin)
        )
        by_frame = mu * (not fixed) / (solved.unit * total)
        constant, square, *linear = through_frame(place, y, origin, solved.unit, by_frame)
        bent = np.stack([square, *linear], axis=-1)
        distance = (rig.offset * rig.offset).sum(axis=-1)
        by_square = constant[..., None] + bent[..., 1:] @ np.swapaxes(rig.offset, -1, -2)
        by_square = by_square + square[..., None] * distance[..., None, :]
        by_square = by_square - (error * pushed).sum(axis=-1)
        by_size = 2 * solved.share / solved.largest * by_square
        proj = None
        if of_cameras:
            places = _from_datum(solved, x), _from_datum(solved, push)
            near = _over_points(solved, squared, error, pushed, *places)
            centers = np.swapaxes(np.broadcast_to(squared, solved.depth.shape), -1, -2) @ bent
            columns = through_centers(
                near, centers, inverse=rig.inverse, places=rig.centers, datum=rig.datum
            )
            proj = np.where(rig.finite[..., None, None], np.concatenate(columns, axis=-1), 0.0)
        return proj, np.moveaxis(by_pixel, -2, -3), np.swapaxes(by_size, -1, -2)


def _pushed(solved: Solved, x: Array, gradient: Array, valid: Array) -> tuple[Array, Array]:
    """(M - mu)^+ of the gradient by x, whose last coordinate divides; and mu, the eigenvalue."""
    scale = solved.unit / x[..., 3]
    along = (gradient * x[..., :3]).sum(axis=-1) / x[..., 3]
    of_x = np.concatenate([gradient, -along[..., None]], axis=-1) * scale[..., None]
    mu = np.where(valid, solved.values[..., 0], 0.0)
    gaps = np.where(valid[..., None], solved.values[..., 1:] - mu[..., None], 1.0)
    others = np.where(valid[..., None, None], solved.vectors[..., 1:], 0.0)
    shares = (np.swapaxes(others, -1, -2) @ of_x[..., None])[..., 0] / gaps
    found: Array = (others @ shares[..., None])[..., 0]
    return found, mu


def _from_datum(solved: Solved, v: Array) -> Array:
    """Homogeneous points ``(*B, N, 4)`` counted from the datum."""
    last = v[..., 3:] / solved.unit[..., None]
    return np.concatenate([v[..., :3] + solved.origin * last, last], axis=-1)


def _over_points(
    solved: Solved, squared: Array, error: Array, pushed: Array, place: Array, push: Array
) -> Array:
    """Gradient ``(*B, V, 3, 4)`` by the cameras of points counted from the datum."""

    def rows(errors: Array) -> Array:
        weighed = squared[..., None] * errors
        last = -(solved.pixels * weighed).sum(axis=-1, keepdims=True)
        found = np.concatenate([weighed, last], axis=-1)
        return np.swapaxes(found.reshape(*found.shape[:-2], -1), -1, -2)

    found: Array = rows(error) @ push + rows(pushed) @ place
    return found.reshape(*found.shape[:-2], -1, 3, 4)
