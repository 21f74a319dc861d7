"""Triangulation of bearing rays, so that any camera model can stand in front.

The rows are r x (R X + t) for unit rays r, weighted: the distance from the ray's line. Solved
in each point's rig frame, where this is nearly the angle. As r x r x = r r^T - 1, a view adds to
the normal matrix only its direction's projector and its centre, and z = 0 is no special place:
rays of fisheye cameras may point anywhere.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import safe_divide, safe_sqrt
from deltas_geom.checks import check_floating, check_shapes
from deltas_geom.numerics.arithmetic import solver_dtype, without_autocast
from deltas_geom.numerics.chunks import cut_points
from deltas_geom.numerics.evaluation import recomputed
from deltas_geom.numerics.ldl import Symmetric4, Vector4
from deltas_geom.status import Status
from deltas_geom.triangulation.judge import judge, ok
from deltas_geom.triangulation.observed import Vector3
from deltas_geom.triangulation.reprojection import parallax_of
from deltas_geom.triangulation.results import Triangulation
from deltas_geom.triangulation.rig_frame import (
    RigFrame,
    camera_moments,
    datum_of,
    rig_frame,
    rig_sums,
)
from deltas_geom.triangulation.solution import (
    FoundPoints,
    derivable_points,
    find_points,
    in_world,
    kept,
)
from deltas_geom.triangulation.weights import Weights, check_weights, weigh


@without_autocast
def triangulate_rays(
    cam_from_world: Tensor,
    rays: Tensor,
    weights: Tensor | None = None,
    mask: Tensor | None = None,
) -> Triangulation:
    """Triangulate matched rays of V posed views, differentiably.

    Args:
        cam_from_world: ``(*B, V, 4, 4)`` rigid.
        rays: ``(*B, V, N, 3)`` in each camera's frame, of any length but 0; z may be negative.
            Those of unused views may hold anything.
        weights: ``(*B, V, N)`` not negative (a sign has no effect). 0 = unused.
        mask: ``(*B, V, N)`` bool, True = used.

    Returns:
        As :func:`triangulate`, with two differences: ``depth`` is the distance along each ray,
        metres (in front means that it is positive), and ``residual`` is the weighted RMS angle
        between the rays and the directions to the point, rad. ``covariance`` is None. A used
        ray of length 0 counts as not finite.

    Raises:
        ShapeError: a trailing shape differs, or there is no view.
        TypeError: the mask is not bool.

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
    check_shapes(cam_from_world=(cam_from_world, "+V 4 4"), rays=(rays, "V N 3"))
    check_floating(cam_from_world=cam_from_world, rays=rays)
    check_weights(weights, mask, "rays", rays, "V N 3", cam_from_world.shape[:-3])

    def known(seen: _Seen, points: Vector3, status: Tensor) -> tuple[Tensor, ...]:
        valid = (status == Status.OK.value).unsqueeze(-2)
        used = ~seen.weights.unused & valid
        along = _along(seen, points)
        angle = _angle(seen, points, along, used)
        squared = torch.where(used, seen.weights.squared, 0.0)
        total = squared.sum(dim=-2)
        mean = safe_divide((squared * angle.square()).sum(dim=-2), total, total > 0)
        residual = safe_sqrt(mean)
        depth = torch.where(valid, along, 0.0)
        parallax = parallax_of(seen.centers, points, used.to(along.dtype))
        limit = torch.finfo(rays.dtype).max
        outward = (
            found.to(rays.dtype).clamp(-limit, limit)
            for found in (torch.stack(points, dim=-1), depth, residual, parallax)
        )
        return (*outward, status)

    def values(*inputs: Tensor) -> tuple[Tensor, ...]:
        posed = _pose(*inputs)
        found, status = _find(posed)
        points = kept(in_world(found.points, posed.datum), ok(status))
        return known(posed.seen, points, status)

    def derivable(*inputs: Tensor) -> tuple[Tensor, ...]:
        posed = _pose(*inputs)
        found, status = _find(posed)
        valid = status == Status.OK.value
        near = derivable_points(posed.normal, posed.frame, found.vector, valid)
        return known(posed.seen, kept(in_world(near, posed.datum), valid), status)

    cut = cut_points(rays, -2, -1, -1, outputs=(-2, -1, -1, -1, -1))
    found = recomputed(derivable, cam_from_world, rays, weights, mask, values=values, cut=cut)
    points, depth, residual, parallax, status = found
    valid = status == Status.OK.value
    return Triangulation(
        points, depth, status, valid, residual, parallax, None, torch.zeros_like(depth)
    )


class _Seen(NamedTuple):
    """The inputs in the solver's type, broadcast, with everything unusable replaced.

    Attributes:
        centers: ``(*B, V, 3)`` of the cameras.
        broken: ``(*B, V)`` 1 for cameras that are not finite, else 0.
        directions: ``(*B, V, 3, N)`` unit, in the world; anything where unsound.
        weights: of the rays.
    """

    centers: Tensor
    broken: Tensor
    directions: Tensor
    weights: Weights


def _see(
    cam_from_world: Tensor, rays: Tensor, weights: Tensor | None, mask: Tensor | None
) -> _Seen:
    work = solver_dtype(rays)
    batch = check_weights(weights, mask, "rays", rays, "V N 3", cam_from_world.shape[:-3])
    pose = cam_from_world.to(work)
    ray = rays.mT.to(work, memory_format=torch.contiguous_format).contiguous()  # (*B, V, 3, N)
    with torch.no_grad():
        # Squares of what is let through can be represented. NaN is not let through.
        finite = (pose[..., :3, :].abs() < torch.finfo(work).max ** 0.25).all(-1).all(-1)
        length = ray.abs().amax(dim=-2)
        sound = (length > 0) & (length <= torch.finfo(work).max)
    # Double where throughout: what is not used must pass no gradient and no NaN.
    pose = torch.where(finite[..., None, None], pose, 0.0)
    # Divided by its largest coordinate it cannot overflow when squared.
    ray = torch.where(sound.unsqueeze(-2), ray, 1.0)
    ray = ray / torch.where(sound, length, 1.0).unsqueeze(-2)
    direction = pose[..., :3, :3].mT @ ray
    # A pose that is not finite turns it into nothing.
    squared = direction.square().sum(dim=-2, keepdim=True)
    return _Seen(
        centers=-(pose[..., :3, :3].mT @ pose[..., :3, 3:]).squeeze(-1),  # whatever the last row
        broken=(~finite).to(work),
        directions=direction * torch.where(squared > 0, squared, 1.0).rsqrt(),
        weights=weigh(weights, mask, batch=batch, like=rays, sound=sound),
    )


class _Posed(NamedTuple):
    """The points' equations, in their frames.

    Attributes:
        seen: the rays.
        datum: ``(*B, 1, 3)`` the origin of the sums, in the world.
        offset: ``(*B, V, 3, N)`` of the frame's origin from the centres, in its units.
        frame: of the points.
        normal: ten ``(*B, N)``, in the frame.
        dtype: of the inputs.
    """

    seen: _Seen
    datum: Tensor
    offset: Tensor
    frame: RigFrame
    normal: Symmetric4
    dtype: torch.dtype


def _pose(
    cam_from_world: Tensor, rays: Tensor, weights: Tensor | None, mask: Tensor | None
) -> _Posed:
    seen = _see(cam_from_world, rays, weights, mask)
    eps = torch.finfo(rays.dtype).eps
    datum = datum_of(seen.centers)
    moments = camera_moments(seen.centers, datum, seen.broken)
    frame = rig_frame(*rig_sums(moments, seen.weights), eps=eps)
    frame = frame._replace(finite=frame.finite & seen.weights.sound)
    centers = (seen.centers - datum)[..., None]
    origin = torch.stack(frame.origin, dim=-2).unsqueeze(-3)
    offset = (origin - centers) / frame.unit.unsqueeze(-2).unsqueeze(-3)
    normal = _normal_matrix(seen.directions, offset, seen.weights.squared)
    return _Posed(seen, datum, offset, frame, normal, rays.dtype)


def _normal_matrix(directions: Tensor, offset: Tensor, squared: Tensor) -> Symmetric4:
    """Sum of w^2 P^T (1 - d d^T) P, P = [1 | offset]."""
    d0, d1, d2 = directions.unbind(dim=-2)
    c0, c1, c2 = offset.unbind(dim=-2)
    # The part of the offset across the ray.
    along = d0 * c0 + d1 * c1 + d2 * c2
    a0, a1, a2 = c0 - d0 * along, c1 - d1 * along, c2 - d2 * along
    w, v0, v1, v2 = squared, squared * d0, squared * d1, squared * d2
    entries = (
        w - v0 * d0, -v0 * d1, -v0 * d2, w * a0,
        w - v1 * d1, -v1 * d2, w * a1,
        w - v2 * d2, w * a2,
        w * (a0 * a0 + a1 * a1 + a2 * a2),
    )  # fmt: skip
    m00, m01, m02, m03, m11, m12, m13, m22, m23, m33 = (entry.sum(dim=-2) for entry in entries)
    return m00, m01, m02, m03, m11, m12, m13, m22, m23, m33


@torch.no_grad()
def _find(posed: _Posed) -> tuple[FoundPoints, Tensor]:
    """Points and their status, without gradient."""

    def product(x: Vector4) -> Vector4:
        return _product(posed, x)

    polish = 2 if posed.dtype == torch.float64 else 0
    eps = torch.finfo(posed.dtype).eps
    found = find_points(posed.normal, posed.frame, eps=eps, product=product, polish=polish)
    x, y, z = in_world(found.points, posed.datum)
    along = _along(posed.seen, (x, y, z))
    # At a camera's centre, within rounding, a point has no angle.
    size = torch.maximum(torch.maximum(x.abs(), y.abs()), z.abs()).unsqueeze(-2)
    size = size + posed.seen.centers.abs().amax(dim=-1)[..., None]
    ahead = along - 64 * torch.finfo(along.dtype).eps * size
    in_front = torch.where(posed.seen.weights.unused, 1.0, ahead).amin(dim=-2) > 0
    held = x.abs() + y.abs() + z.abs() <= torch.finfo(posed.dtype).max
    frame = posed.frame
    status = judge(
        finite=frame.finite,
        enough=frame.enough,
        posed=found.posed,
        near=found.near & held,
        in_front=in_front,
    )
    return found, status


def _product(posed: _Posed, x: Vector4) -> Vector4:
    """The normal matrix times x, from the rows: it is not squared."""
    place = torch.stack(x[:3], dim=-2).unsqueeze(-3)
    line = place + posed.offset * x[3].unsqueeze(-2).unsqueeze(-3)
    directions = posed.seen.directions
    across = line - directions * (directions * line).sum(dim=-2, keepdim=True)
    across = across * posed.seen.weights.squared.unsqueeze(-2)
    g0, g1, g2 = across.sum(dim=-3).unbind(dim=-2)
    return g0, g1, g2, (across * posed.offset).sum(dim=-2).sum(dim=-2)


def _along(seen: _Seen, points: Vector3) -> Tensor:
    """Distance along each ray, ``(*B, V, N)`` metres."""
    offset = torch.stack(points, dim=-2).unsqueeze(-3) - seen.centers[..., None]
    return (seen.directions * offset).sum(dim=-2)


def _angle(seen: _Seen, points: Vector3, along: Tensor, used: Tensor) -> Tensor:
    """Angle from each ray, ``(*B, V, N)`` rad."""
    offset = torch.stack(points, dim=-2).unsqueeze(-3) - seen.centers[..., None]
    across = torch.linalg.cross(seen.directions.expand_as(offset), offset, dim=-2)
    squared = across.square().sum(dim=-2)
    apart = used & (squared > 0)
    # sqrt and atan2 have no slope at a perfect match; the gradient there is taken as 0.
    sine = torch.where(apart, torch.where(apart, squared, 1.0).sqrt(), 0.0)
    return torch.atan2(sine, torch.where(used, along, 1.0))
