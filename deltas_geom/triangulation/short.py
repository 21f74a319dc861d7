"""The short way for few points: the equations row by row, and LAPACK's eigenvectors.

What 17 joints of a person cost is the number of operations, not their size. NumPy's take a third of
the time of torch's, so these are NumPy's, in float64, with the gradient spelled out. The frames are
those of `rig_frame`, the reasons of failures those of `judge`. N comes before V here.
"""

from typing import Any, NamedTuple

import numpy as np
import torch

from deltas_geom.numerics.vectors import Array
from deltas_geom.triangulation.dlt import rows
from deltas_geom.triangulation.judge import REASONS
from deltas_geom.triangulation.observed import Cameras
from deltas_geom.triangulation.rig_frame import has_spread, stand_apart
from deltas_geom.triangulation.weights import Weighed, weigh_at_hand

FEW = 256
"""Points up to which this is the shorter way."""
_POLISH = 2
_EPS = float(np.finfo(np.float64).eps)
_LIMIT = float(np.finfo(np.float64).max)


class ShortRig(NamedTuple):
    """What depends on the cameras alone.

    Attributes:
        proj: ``(*B, V, 3, 4)``, 0 for cameras that are not finite.
        finite: ``(*B, V)`` bool.
        inverse: ``(*B, V, 3, 3)`` of the first three columns; 0 if there is none.
        centers: ``(*B, V, 3)``.
        datum: ``(*B, 1, 3)`` near the cameras; points are counted from there.
        offset: ``(*B, V, 3)`` of the centres from the datum.
        near: ``(*B, V, 3)`` the last columns for points so counted.
    """

    proj: Array
    finite: Array
    inverse: Array
    centers: Array
    datum: Array
    offset: Array
    near: Array

    def cameras(self) -> Cameras:
        """For the long way."""
        proj, inverse, centers = map(torch.from_numpy, (self.proj, self.inverse, self.centers))
        return Cameras(proj, torch.from_numpy(~self.finite).double(), inverse, centers)


class Solved(NamedTuple):
    """Points, and what their gradient needs.

    Attributes:
        points: ``(*B, N, 3)`` in the world; 0 where they fail.
        status: ``(*B, N)`` int8.
        depth: ``(*B, N, V)`` anything where they fail.
        pixels: ``(*B, N, V, 2)`` 0 where not finite.
        share: ``(*B, N, V)`` weights by each point's largest, 0 where unused.
        largest: ``(*B, N, 1)`` that.
        used: ``(*B, N, V)`` bool.
        origin: ``(*B, N, 3)`` of the frame, from the datum.
        unit: ``(*B, N)`` of the frame.
        cameras: ``(*B, N, V, 3, 4)`` of points in the frame.
        equations: ``(*B, N, V, 2, 4)`` without weights.
        values: ``(*B, N, 4)`` eigenvalues of the normal matrix, ascending; of one view may be 2.
        vectors: ``(*B, N, 4, 4)`` its eigenvectors, columns.
    """

    points: Array
    status: Array
    depth: Array
    pixels: Array
    share: Array
    largest: Array
    used: Array
    origin: Array
    unit: Array
    cameras: Array
    equations: Array
    values: Array
    vectors: Array


def short_rig(proj: Array) -> ShortRig:
    """All that is needed of cameras ``(*B, V, 3, 4)``.

    Source: Hartley and Zisserman, 2nd ed., section 6.2.4 (centres).
    """
    with np.errstate(all="ignore"):
        proj = proj.astype(np.float64)
        finite = np.abs(proj).max(axis=(-2, -1)) < _LIMIT**0.25  # NaN is not below
        if not finite.all():
            proj = np.where(finite[..., None, None], proj, 0.0)
        matrix = proj[..., :3]
        product = np.sqrt((matrix * matrix).sum(axis=-1)).prod(axis=-1)
        exists = np.abs(np.linalg.det(matrix)) > 4 * _EPS * product
        if exists.all():
            inverse = np.linalg.inv(matrix)
        else:
            exists = exists[..., None, None]
            inverse = np.where(exists, np.linalg.inv(np.where(exists, matrix, np.eye(3))), 0.0)
        centers = -(inverse @ proj[..., 3:])[..., 0]
        middle = (centers.shape[-2] - 1) // 2
        datum = np.sort(centers, axis=-2)[..., middle : middle + 1, :]
        # Of M (x - centre): nothing cancels, wherever the world's origin is.
        near = proj[..., 3] + (matrix @ datum[..., None])[..., 0]
        return ShortRig(proj, finite, inverse, centers, datum, centers - datum, near)


def solve(
    rig: ShortRig,
    pixels: Array,
    weights: Array | None,
    mask: Array | None,
    *,
    fixed: bool,
    dtype: np.dtype[Any],
) -> Solved:
    """Points of pixels ``(*B, V, N, 2)``, with weights and mask as of :func:`weigh`.

    ``fixed``: in the world's frame; ``dtype``: of the inputs.
    """
    with np.errstate(all="ignore"):
        seen, share, largest, used, sound = _observed(pixels, weights, mask)
        squared = share * share
        total = np.maximum(squared.sum(axis=-1, keepdims=True), 1.0)
        origin = squared @ rig.offset / total
        distance = (rig.offset * rig.offset).sum(axis=-1)
        spread = _over(squared, distance) / total[..., 0] - (origin * origin).sum(axis=-1)
        counted = used.astype(np.float64) if used.shape[-2] == share.shape[-2] else used * 1.0
        size, middle, reach, posed, enough = _stand(rig, counted, distance, dtype)
        unit = np.sqrt(np.where(has_spread(spread, size, own=_EPS), spread, 1.0))
        if fixed:
            origin, unit = np.broadcast_to(-rig.datum, origin.shape), np.ones_like(unit)

        matrix = rig.proj[..., None, :, :, :3]
        last = (matrix @ origin[..., None, :, None])[..., 0] + rig.near[..., None, :, :]
        cameras = np.empty((*last.shape, 4))
        cameras[..., :3] = matrix
        cameras[..., 3] = last / unit[..., None, None]
        equations = rows(cameras, seen)
        values, vectors = _null_vectors(
            equations * share[..., None, None], exactly=fixed or dtype.itemsize == 8
        )
        x = vectors[..., 0]
        from_datum = origin + unit[..., None] * x[..., :3] / x[..., 3:]
        from_datum = np.where(np.isfinite(from_datum), from_datum, _LIMIT**0.25)

        depth = from_datum @ np.swapaxes(rig.proj[..., 2, :3], -1, -2) + rig.near[..., None, :, 2]
        beside = from_datum - middle
        points = from_datum + rig.datum
        held = np.abs(points).sum(axis=-1) <= np.finfo(dtype).max
        near = (16 * np.finfo(dtype).eps) ** 2 * (beside * beside).sum(axis=-1) <= reach
        simple = values[..., 1] - values[..., 0] > 64 * _EPS * values.sum(axis=-1)
        finite = sound & (rig.finite[..., None, :] | ~used).all(axis=-1)
        status = _judged(finite, enough, posed & simple, near & held, (depth > 0) | ~used)
        if status.any():
            points = np.where(status[..., None] == 0, points, 0.0)
        return Solved(
            points, status, depth, seen, share, largest, used,
            origin, unit, cameras, equations, values, vectors,
        )  # fmt: skip


def _over(squared: Array, values: Array) -> Array:
    """Sums ``(*B, N)`` over views of ``(*B, N, V)`` times ``(*B, V)``."""
    found: Array = (squared @ values[..., None])[..., 0]
    return found


def _observed(pixels: Array, weights: Array | None, mask: Array | None) -> Weighed:
    """Points before views; without a batch what no weight and no mask tells apart."""
    seen = np.moveaxis(pixels, -3, -2).astype(np.float64)
    weights, mask = (t if t is None else np.swapaxes(t, -1, -2) for t in (weights, mask))
    ones = np.ones((1,) * (seen.ndim - 3) + seen.shape[-3:-1])
    return weigh_at_hand(seen, weights, mask, ones, coordinates=-1, views=-1)


def _stand(
    rig: ShortRig, counted: Array, distance: Array, dtype: np.dtype[Any]
) -> tuple[Array, Array, Array, Array, Array]:
    """How the used cameras stand, all alike, see :func:`rig_frame.rig_frame`.

    Mean squared distance from the datum, mean, squared spread; are they apart, are they enough?
    """
    count = counted.sum(axis=-1)
    share = 1 / np.maximum(count, 1)
    size = _over(counted, distance) * share
    middle = counted @ rig.offset * share[..., None]
    reach = size - (middle * middle).sum(axis=-1)
    from_world = _over(counted, (rig.centers * rig.centers).sum(axis=-1)) * share
    eps = float(np.finfo(dtype).eps)
    return size, middle, reach, *stand_apart(count, reach, size, from_world, eps=eps, own=_EPS)


def _null_vectors(equations: Array, *, exactly: bool) -> tuple[Array, Array]:
    """Eigenvalues and eigenvectors of A^T A; the first vector from A, if its digits matter."""
    a = equations.reshape(*equations.shape[:-3], -1, 4)
    if not exactly:
        values, vectors = np.linalg.eigh(np.swapaxes(a, -1, -2) @ a)
        return values, vectors
    _, singular, right = np.linalg.svd(a, full_matrices=False)
    values, vectors = singular[..., ::-1] ** 2, np.swapaxes(right[..., ::-1, :], -1, -2)
    # Coordinates may be of very different size, of which the small ones lose digits.
    x, others = vectors[..., :1], vectors[..., 1:]
    for _ in range(_POLISH):
        image = np.swapaxes(a, -1, -2) @ (a @ x)
        mu = (x * image).sum(axis=-2, keepdims=True)
        gaps = values[..., 1:, None] - mu
        shares = np.swapaxes(others, -1, -2) @ (image - mu * x) / np.where(gaps > 0, gaps, np.inf)
        x = x - others @ shares
    return values, np.concatenate([x, others], axis=-1)


def _judged(finite: Array, enough: Array, posed: Array, near: Array, ahead: Array) -> Array:
    """As :func:`judge`."""
    in_front = ahead.all(axis=-1)
    status = np.zeros(in_front.shape, dtype=np.int8)
    if not (in_front & near & posed & enough & finite).all():
        passes = (in_front, near, posed, enough, finite)
        for passed, reason in zip(passes, REASONS, strict=True):
            status = np.where(passed, status, np.int8(reason.value))
    return status


def describe(rig: ShortRig, solved: Solved) -> tuple[Array, Array, Array, Array]:
    """Depth ``(*B, V, N)``, residual px, parallax rad ``(*B, N)``, errors px ``(*B, V, N)``.

    All are 0 where a point is not valid.
    """
    with np.errstate(all="ignore"):
        valid = (solved.status == 0)[..., None]
        depth = np.where(valid, solved.depth, 0.0)
        seen = solved.used & valid & (depth > 0)
        from_datum = np.where(valid, solved.points - rig.datum, 0.0)
        place = np.concatenate([rig.proj[..., :3], rig.near[..., None]], axis=-1)
        ahead = place[..., None, :, :2, :3] @ from_datum[..., None, :, None]
        pixels = (ahead[..., 0] + place[..., None, :, :2, 3]) / depth[..., None]
        offset = np.where(seen[..., None], pixels - solved.pixels, 0.0)
        squared = np.where(seen, solved.share * solved.share, 0.0)
        apart = (offset * offset).sum(axis=-1)
        sums = (squared * apart).sum(axis=-1)
        total = squared.sum(axis=-1)
        residual = np.sqrt(np.where(total > 0, sums / total, 0.0))
        rays = from_datum[..., None, :] - rig.offset[..., None, :, :]
        length = np.sqrt((rays * rays).sum(axis=-1, keepdims=True))
        rays = np.where(length > 0, rays / length, 0.0)
        used = solved.used & valid
        chord = rays[..., None, :, :] - rays[..., :, None, :]
        chords = (chord * chord).sum(axis=-1) * (used[..., None, :] & used[..., :, None])
        parallax = 2 * np.arcsin(np.minimum(0.5 * np.sqrt(chords.max(axis=(-2, -1))), 1.0))
        errors = np.swapaxes(np.sqrt(apart), -1, -2)
        return np.swapaxes(depth, -1, -2), residual, parallax, errors
