"""Triangulation of bearing rays, so that any camera model can stand in front.

The rows are r x (R X + t) for unit rays r, weighted: the distance from the ray's line. Solved
in each point's rig frame, where this is nearly the angle. As r x r x = r r^T - 1, a view adds to
the normal matrix only its direction's projector and its centre, and z = 0 is no special place:
rays of fisheye cameras may point anywhere.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.numerics.arithmetic import without_autocast
from deltas_geom.numerics.vectors import Symmetric4, Vector3, Vector4, dot, plus, scaled
from deltas_geom.triangulation.bearings import (
    Bearings,
    across,
    across_sums,
    describe_rays,
    see_rays,
)
from deltas_geom.triangulation.observed import check_observed
from deltas_geom.triangulation.operation import operation
from deltas_geom.triangulation.results import Triangulation
from deltas_geom.triangulation.rig_frame import RigFrame, camera_moments, rig_frame, rig_sums
from deltas_geom.triangulation.solution import follow_linear, solve_linear


@without_autocast
def triangulate_rays(
    cam_from_world: Tensor,
    rays: Tensor,
    weights: Tensor | None = None,
    mask: Tensor | None = None,
    *,
    covariance: bool = False,
    max_residual: float | None = None,
) -> Triangulation:
    """Triangulate matched rays of V posed views, differentiably.

    Args:
        cam_from_world: ``(*B, V, 4, 4)`` rigid.
        rays: ``(*B, V, N, 3)`` in each camera's frame, of any length but 0; z may be negative.
            Those of unused views may hold anything.
        weights: ``(*B, V, N)`` not negative (a sign has no effect). 0 = unused.
        mask: ``(*B, V, N)`` bool, True = used.
        covariance: also compute the covariance of the points.
        max_residual: rad; points about which the views disagree by more are RESIDUAL_TOO_LARGE.
            Rays handed over as (N, V, 3) where N = V have residuals of many degrees, too.

    Returns:
        As :func:`triangulate`, but all in angles: ``depth`` is the distance along each ray,
        metres (in front means that it is positive), ``errors`` are the angles between the rays
        and the directions to the point and ``residual`` is their weighted RMS, rad; the
        covariance is for rays that are off by a standard deviation of 1 / weight rad to each
        side. A used ray of length 0 counts as not finite.

    Raises:
        ShapeError: a trailing shape differs, or there is no view.
        TypeError: the mask is not bool.
        ValueError: ``max_residual`` is not positive.

    Source: Hartley and Zisserman, 2nd ed., section 12.2, with the cross product's three rows
    in place of two.

    Example:
        >>> right = torch.eye(4)
        >>> right[0, 3] = -0.2  # 20 cm to the right
        >>> rays = torch.tensor([[[0.1, 0.05, 1.0]], [[0.0, 0.25, 5.0]]])
        >>> result = triangulate_rays(torch.stack([torch.eye(4), right]), rays)
        >>> result.points.round(decimals=3)
        tensor([[0.2000, 0.1000, 2.0000]])
    """
    check_observed(cam_from_world=cam_from_world, rays=rays, weights=weights, mask=mask)
    return operation(
        Triangulation,
        (cam_from_world, rays, weights, mask),
        see=_pose,
        solve=solve_linear,
        follow=follow_linear,
        describe=lambda posed, found, *known: describe_rays(posed.seen, found.points, *known),
        dtype=rays.dtype,
        covariance=covariance,
        max_residual=max_residual,
    )


class _Posed(NamedTuple):
    """The points' equations, in their frames: :class:`Linear`.

    Attributes:
        seen: the rays.
        offset: three ``(*B, V, N)`` of the frame's origin from the centres, in its units.
        frame: of the points.
        normal: ten ``(*B, N)``, in the frame.
    """

    seen: Bearings
    offset: Vector3
    frame: RigFrame
    normal: Symmetric4

    @property
    def datum(self) -> Tensor:
        return self.seen.datum

    @property
    def dtype(self) -> torch.dtype:
        return self.seen.dtype

    def in_front(self, points: Vector3) -> Tensor:
        return self.seen.in_front(points)

    def product(self, x: Vector4) -> Vector4:
        *place, last = (component.unsqueeze(-2) for component in x)
        lines = plus(tuple(place), last, self.offset)
        beside = scaled(across(self.seen.directions, lines), self.seen.weights.squared)
        return tuple(part.sum(dim=-2) for part in (*beside, dot(beside, self.offset)))


def _pose(
    cam_from_world: Tensor, rays: Tensor, weights: Tensor | None, mask: Tensor | None
) -> _Posed:
    seen = see_rays(cam_from_world, rays, weights, mask)
    moments = camera_moments(seen.centers, seen.datum, seen.broken)
    frame = rig_frame(*rig_sums(moments, seen.weights), eps=torch.finfo(rays.dtype).eps)
    frame = frame._replace(finite=frame.finite & seen.weights.sound)
    held = frame.held()
    unit = held.unit.unsqueeze(-2)
    offset = tuple(part / unit for part in seen.offsets(held.origin))
    normal = _normal_matrix(seen.directions, offset, seen.weights.squared)
    return _Posed(seen, offset, frame, normal)


def _normal_matrix(directions: Vector3, offset: Vector3, squared: Tensor) -> Symmetric4:
    """Sum of w^2 P^T (1 - d d^T) P, P = [1 | offset]."""
    m00, m01, m02, m11, m12, m22 = across_sums(squared, directions)
    beside = across(directions, offset)
    entries = *scaled(beside, squared), squared * dot(beside, beside)
    m03, m13, m23, m33 = (entry.sum(dim=-2) for entry in entries)
    return m00, m01, m02, m03, m11, m12, m13, m22, m23, m33
