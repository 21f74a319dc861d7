"""Rays of posed cameras in the solver's type, cleaned and flagged; and points as these see them.

Everything downstream may multiply and divide without asking: what is not used passes no NaN and no
gradient.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import safe_divide, safe_sqrt
from deltas_geom.numerics.arithmetic import outside_gradients, solver_dtype, surely_all
from deltas_geom.numerics.vectors import Symmetric3, Vector3, dot, minus, scaled
from deltas_geom.triangulation.observed import check_observed, finite_cameras
from deltas_geom.triangulation.reprojection import mean_of, parallax_of
from deltas_geom.triangulation.rig_frame import datum_of
from deltas_geom.triangulation.solution import in_world, kept
from deltas_geom.triangulation.uncertainty import inverse_information, unscaled
from deltas_geom.triangulation.weights import Weights, weigh


class Bearings(NamedTuple):
    """Rays of N points from V views.

    Attributes:
        centers: ``(*B, V, 3)`` of the cameras; 0 if not finite.
        datum: ``(*B, 1, 3)`` a place near the cameras, from which points are counted.
        broken: ``(*B, V)`` 1 for cameras that are not finite, else 0.
        directions: three ``(*B, V, N)`` unit, in the world; any where unsound.
        sound: ``(*B, V, N)`` bool: the ray and its camera are finite, and it has a direction.
        weights: of the rays.
        dtype: of the inputs.
    """

    centers: Tensor
    datum: Tensor
    broken: Tensor
    directions: Vector3
    sound: Tensor
    weights: Weights
    dtype: torch.dtype

    def offsets(self, points: Vector3) -> Vector3:
        """From the centres to points three ``(*B, N)`` beside the datum: three ``(*B, V, N)``."""
        centers = (self.centers - self.datum)[..., None].unbind(dim=-2)
        return tuple(p.unsqueeze(-2) - c for p, c in zip(points, centers, strict=True))

    def in_front(self, points: Vector3) -> Tensor:
        """Is each point ahead on all its used rays, by more than rounding? ``(*B, N)``."""
        with outside_gradients():
            along = dot(self.directions, self.offsets(points))
            # At a camera's centre, within rounding, a point has no angle.
            size = _largest(in_world(points, self.datum)).unsqueeze(-2)
            size = size + self.centers.abs().amax(dim=-1)[..., None]
            ahead = along > 64 * torch.finfo(along.dtype).eps * size
            return (ahead | self.weights.unused).all(dim=-2)


def see_rays(
    cam_from_world: Tensor, rays: Tensor, weights: Tensor | None, mask: Tensor | None
) -> Bearings:
    """Tell used rays ``(*B, V, N, 3)`` of cameras ``(*B, V, 4, 4)`` from others."""
    work = solver_dtype(rays)
    batch = check_observed(cam_from_world=cam_from_world, rays=rays, weights=weights, mask=mask)
    pose, broken = finite_cameras(cam_from_world[..., :3, :])  # whatever the last row
    x, y, z = (one.to(work, memory_format=torch.contiguous_format) for one in rays.unbind(dim=-1))
    with outside_gradients():
        length = _largest((x, y, z))
        sound = (length > 0) & (length <= torch.finfo(work).max)
    # Double where throughout: what is not used must pass no gradient and no NaN.
    # Divided by its largest coordinate it cannot overflow when squared.
    ray = tuple(safe_divide(one, length, sound) for one in (x, y, z))
    rows = pose[..., :3].unsqueeze(-2).unbind(dim=-3)  # each (*B, V, 1, 3)
    ray = tuple(dot(ray, tuple(row[..., i] for row in rows)) for i in range(3))
    square = dot(ray, ray)
    # A pose that is no rotation may turn a ray into nothing.
    sound = sound & (broken == 0).unsqueeze(-1) & (square.detach() > torch.finfo(work).tiny ** 0.4)
    every = surely_all(sound)
    inverse = square.rsqrt() if every else torch.where(sound, square, 1.0).rsqrt()
    centers = -(pose[..., :3] * pose[..., 3:]).sum(dim=-2)
    weighed = weigh(weights, mask, batch=batch, like=rays, sound=None if every else sound)
    return Bearings(
        centers, datum_of(centers), broken, scaled(ray, inverse), sound, weighed, rays.dtype
    )


def describe_rays(
    seen: Bearings, points: Vector3, valid: Tensor, covariance: bool
) -> dict[str, Tensor]:
    """The fields of a :class:`Triangulation` of points three ``(*B, N)`` beside the datum."""
    points, weights, both = kept(points, valid), seen.weights, valid.unsqueeze(-2)
    used = ~weights.unused & both
    offset = seen.offsets(points)
    along, angle = angles_of(seen, offset, used)
    place = kept(in_world(points, seen.datum), valid)
    found = {
        "points": torch.stack(place, dim=-1),
        "depth": torch.where(both, along, 0.0),
        "residual": mean_of(angle.square(), used, weights.squared),
        "parallax": parallax_of(seen.centers - seen.datum, points, used.to(along.dtype)),
        "errors": angle,
    }
    if covariance:
        # The noise of a ray, times the distance, moves its line across itself alone.
        distance = dot(offset, offset)
        share = safe_divide(weights.squared.expand_as(along), distance, used)
        share = safe_divide(share, distance, used)
        inverse = inverse_information(across_sums(share, offset), used.sum(dim=-2) >= 2)
        found["covariance"] = unscaled(inverse, weights.largest.squeeze(-2))
    return found


def angles_of(seen: Bearings, offset: Vector3, used: Tensor) -> tuple[Tensor, Tensor]:
    """Lengths along the rays of :meth:`Bearings.offsets`, m; angles from the used ones, rad."""
    along, beside = dot(seen.directions, offset), across(seen.directions, offset)
    # sqrt and atan2 have no slope at a perfect match; the gradient there is taken as 0.
    sine = safe_sqrt(torch.where(used, dot(beside, beside), 0.0))
    return along, torch.atan2(sine, torch.where(used, along, 1.0))


def across_sums(weight: Tensor, vector: Vector3) -> Symmetric3:
    """Sums over views of w (|v|^2 - v v^T), of w and v ``(*B, V, N)``: six ``(*B, N)``.

    Between points and vectors of unit length that is the squared distance from their lines.
    """
    x, y, z = vector
    a, b, c = scaled(vector, weight)
    entries = (
        torch.addcmul(b * y, c, z), -a * y, -a * z,
        torch.addcmul(a * x, c, z), -b * z,
        torch.addcmul(a * x, b, y),
    )  # fmt: skip
    return tuple(entry.sum(dim=-2) for entry in entries)


def across(directions: Vector3, vector: Vector3) -> Vector3:
    """The part of vectors orthogonal to unit directions."""
    return minus(vector, dot(directions, vector), directions)


def _largest(vector: Vector3) -> Tensor:
    x, y, z = vector
    return torch.maximum(torch.maximum(x.abs(), y.abs()), z.abs())
