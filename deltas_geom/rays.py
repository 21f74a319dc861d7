"""Triangulation of bearing rays, so that any camera model can stand in front.

The rows are r x (R X + t) for unit rays r, weighted: the distance from the ray's line. Solved
in each point's rig frame, where this is nearly the angle. As r x r x = r r^T - 1, a view adds to
the normal matrix only its direction's projector and its centre, and z = 0 is no special place:
rays of fisheye cameras may point anywhere.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.checks import batch_shape, check_shapes
from deltas_geom.homogeneous import safe_divide
from deltas_geom.null_vector import Symmetric4, null_vector
from deltas_geom.poses import camera_centers
from deltas_geom.status import Status
from deltas_geom.triangulation import Triangulation
from deltas_geom.uncertainty import ray_parallax, solver_dtype

# As in triangulation: squared and times a small parallax, less would be lost in rounding.
_NEGLIGIBLE_WEIGHT = 1e-6


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
        ShapeError: a trailing shape differs.

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
    check_shapes(cam_from_world=(cam_from_world, "V 4 4"), rays=(rays, "V N 3"))
    seen = _see(cam_from_world, rays, weights, mask)
    frame = _frame(seen)
    normal = _normal_matrix(seen, frame)
    found = solve_points(normal, frame, eps=torch.finfo(rays.dtype).eps)

    # Distance along the ray and the angle to it, of what is not yet known to be in front.
    offset = found.points.unsqueeze(-3) - seen.centers[..., None]  # (*B, V, 3, N)
    along = (seen.directions * offset).sum(dim=-2)
    size = torch.maximum(found.points.abs().amax(dim=-2), along.abs().amax(dim=-2)).detach()
    # At a camera's centre, within rounding, a point has no angle.
    least = 64 * torch.finfo(along.dtype).eps * torch.maximum(size, frame.farthest)
    status = judge_points(
        found,
        in_front=((along > least.unsqueeze(-2)) | ~seen.used).all(dim=-2),
        size=size,
        largest=torch.finfo(rays.dtype).max,
        enough=seen.enough,
        finite=seen.finite,
    )
    valid = status == Status.OK
    used = seen.used & valid.unsqueeze(-2)
    points = torch.where(valid.unsqueeze(-2), found.points, 0.0).mT.to(rays.dtype)
    depth = torch.where(valid.unsqueeze(-2), along, 0.0).to(rays.dtype)

    across = torch.linalg.cross(seen.directions.expand_as(offset), offset, dim=-2)
    squared_across = across.square().sum(dim=-2)
    moved = used & (squared_across > 0)
    # sqrt and atan2 have no slope at a perfect match; the gradient there is taken as 0.
    sine = torch.where(moved, torch.where(moved, squared_across, 1.0).sqrt(), 0.0)
    angle = torch.atan2(sine, torch.where(used, along, 1.0))
    total = seen.squared.sum(dim=-2)
    mean = safe_divide((seen.squared * angle.square()).sum(dim=-2), total, valid & (total > 0))
    positive = valid & (mean > 0)
    residual = torch.where(positive, torch.where(positive, mean, 1.0).sqrt(), 0.0)
    poses = torch.where(seen.known_pose[..., None, None], cam_from_world, 0.0).detach()
    parallax = ray_parallax(poses[..., :3, :], points, used)
    return Triangulation(points, depth, status, valid, residual.to(rays.dtype), parallax, None)


class _Seen(NamedTuple):
    """The inputs in the solver's type, broadcast, with everything unusable replaced.

    Attributes:
        centers: ``(*B, V, 3)`` of the cameras.
        known_pose: ``(*B, V)`` the pose is finite.
        directions: ``(*B, V, 3, N)`` unit, in the world; anything where unused.
        squared: ``(*B, V, N)`` squared weights, largest 1; 0 where unused.
        used: ``(*B, V, N)`` of points that may be solvable.
        counts: ``(*B, V, N)`` the view's weight is not negligible beside the largest.
        finite: ``(*B, N)`` everything used is.
        enough: ``(*B, N)`` at least two views count.
    """

    centers: Tensor
    known_pose: Tensor
    directions: Tensor
    squared: Tensor
    used: Tensor
    counts: Tensor
    finite: Tensor
    enough: Tensor


def _see(
    cam_from_world: Tensor, rays: Tensor, weights: Tensor | None, mask: Tensor | None
) -> _Seen:
    weight = torch.ones_like(rays[..., 0])
    if weights is not None:
        check_shapes(weights=(weights, "V N"), rays=(rays, "V N 3"))
        weight = weight * weights
    if mask is not None:
        check_shapes(mask=(mask, "V N"), rays=(rays, "V N 3"))
        weight = torch.where(mask, weight, 0.0)
    work = solver_dtype(rays)
    batch = batch_shape(cam_from_world.shape[:-3], weight.shape[:-2])
    weight = weight.to(work).expand(*batch, *weight.shape[-2:])
    pose, ray = cam_from_world.to(work), rays.to(work).mT  # (*B, V, 3, N)

    # Squares of what is let through can be represented. NaN is not let through.
    limit = torch.finfo(work).max ** 0.25
    known_pose = (pose[..., :3, :].abs() < limit).all(-1).all(-1)
    length = ray.detach().abs().amax(dim=-2)
    known = (length > 0) & length.isfinite() & weight.isfinite() & known_pose[..., None]
    used = weight != 0  # NaN counts as used, and is caught as not finite
    finite = (known | ~used).all(dim=-2)
    size = torch.where(used, weight.detach().abs(), 0.0)
    largest = size.amax(dim=-2, keepdim=True)
    counts = used & (size > _NEGLIGIBLE_WEIGHT * largest)
    enough = counts.sum(dim=-2) >= 2
    used = used & (finite & enough).unsqueeze(-2)
    share = weight / torch.where(largest > 0, largest, 1.0)

    # Double where throughout: what is not used must pass no gradient and no NaN.
    pose = torch.where(known_pose[..., None, None], pose, 0.0)
    # Divided twice: the largest coordinate cannot overflow when squared.
    ray = torch.where(used.unsqueeze(-2), ray, 1.0)
    ray = ray / torch.where(used, length, 1.0).unsqueeze(-2)
    ray = ray / ray.square().sum(dim=-2, keepdim=True).sqrt()
    return _Seen(
        centers=camera_centers(pose),
        known_pose=known_pose,
        directions=pose[..., :3, :3].mT @ ray,
        squared=torch.where(used, share, 0.0).square(),
        used=used,
        counts=counts,
        finite=finite,
        enough=enough,
    )


class RigFrame(NamedTuple):
    """Where each of N points is solved: x = unit x' + origin.

    Attributes:
        origin: ``(*B, 3, N)`` mean of the centres, weighted by the squared weights.
        unit: ``(*B, N)`` their spread.
        reach: ``(*B, N)`` largest distance of a centre that counts from the origin.
        farthest: ``(*B, N)`` largest distance of a centre that counts from the world's origin.
        posed: ``(*B, N)`` the inputs are finite and enough.
    """

    origin: Tensor
    unit: Tensor
    reach: Tensor
    farthest: Tensor
    posed: Tensor


def _frame(seen: _Seen) -> RigFrame:
    total = seen.squared.sum(dim=-2)
    share = safe_divide(seen.squared, total.unsqueeze(-2), (total > 0).unsqueeze(-2))
    # Its rounding, far from the world's origin, does no harm: any origin near by will do.
    origin = seen.centers.mT @ share
    apart = (seen.centers[..., None] - origin.unsqueeze(-3)).square().sum(dim=-2)  # (*B, V, N)
    variance = (share * apart).sum(dim=-2)
    unit = torch.where(variance > torch.finfo(variance.dtype).tiny, variance, 1.0).sqrt()
    reach = torch.where(seen.counts, apart.detach(), 0.0).amax(dim=-2).sqrt()
    from_world = seen.centers.detach().norm(dim=-1)[..., None]
    farthest = torch.where(seen.counts, from_world, 0.0).amax(dim=-2)
    return RigFrame(origin, unit, reach, farthest, seen.finite & seen.enough)


def _normal_matrix(seen: _Seen, frame: RigFrame) -> Symmetric4:
    """Sum of w^2 P^T (1 - d d^T) P in each point's frame, P = [1 | -c']."""
    center = seen.centers[..., None] - frame.origin.unsqueeze(-3)  # (*B, V, 3, N)
    center = center / frame.unit.unsqueeze(-2).unsqueeze(-3)
    d0, d1, d2 = seen.directions.unbind(dim=-2)
    c0, c1, c2 = center.unbind(dim=-2)
    w = seen.squared
    # The part of the centre across the ray, -(1 - d d^T) c'.
    along = d0 * c0 + d1 * c1 + d2 * c2
    a0, a1, a2 = d0 * along - c0, d1 * along - c1, d2 * along - c2
    v0, v1, v2 = w * d0, w * d1, w * d2
    entries = (
        w - v0 * d0, -v0 * d1, -v0 * d2, w * a0,
        w - v1 * d1, -v1 * d2, w * a1,
        w - v2 * d2, w * a2,
        w * (a0 * a0 + a1 * a1 + a2 * a2),
    )  # fmt: skip
    m00, m01, m02, m03, m11, m12, m13, m22, m23, m33 = (entry.sum(dim=-2) for entry in entries)
    return m00, m01, m02, m03, m11, m12, m13, m22, m23, m33


class FoundPoints(NamedTuple):
    """Points before they are judged.

    Attributes:
        points: ``(*B, 3, N)`` in the world; 0 where there is none.
        posed: ``(*B, N)`` they have a place or a direction.
        at_infinity: ``(*B, N)`` it is a direction.
    """

    points: Tensor
    posed: Tensor
    at_infinity: Tensor


def solve_points(normal: Symmetric4, frame: RigFrame, *, eps: float) -> FoundPoints:
    """Points whose normal matrices, ten ``(*B, N)``, are given in their rig frames.

    Args:
        normal: of rows in any unit.
        frame: of the points.
        eps: rounding of the inputs, relative.
    """
    # Centres closer together than the rounding of where they are do not differ.
    posed = frame.posed & (frame.reach > 64 * eps * frame.farthest)
    trace = (normal[0] + normal[4] + normal[7] + normal[9]).detach()
    posed = posed & (trace > 0) & trace.isfinite()
    scale = torch.where(posed, trace, 1.0)
    easy = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.1)
    m00, m01, m02, m03, m11, m12, m13, m22, m23, m33 = (
        torch.where(posed, entry / scale, constant)
        for entry, constant in zip(normal, easy, strict=True)
    )
    matrix = (m00, m01, m02, m03, m11, m12, m13, m22, m23, m33)
    (x0, x1, x2, x3), simple = null_vector(matrix)
    posed = posed & simple

    # Far above the smallest number, so that the gradient of the division is finite.
    divisible = x3 > torch.finfo(x3.dtype).tiny ** (1 / 3)
    inverse = safe_divide(torch.ones_like(x3), x3, posed & divisible) * frame.unit
    offset = torch.stack([x0, x1, x2], dim=-2) * inverse.unsqueeze(-2)
    distance = offset.detach().square().sum(dim=-2).sqrt()
    at_infinity = ~divisible | (16 * eps * distance > frame.reach)
    where = (posed & ~at_infinity).unsqueeze(-2)
    return FoundPoints(torch.where(where, offset + frame.origin, 0.0), posed, at_infinity)


def judge_points(
    found: FoundPoints,
    *,
    in_front: Tensor,
    size: Tensor,
    largest: float,
    enough: Tensor,
    finite: Tensor,
) -> Tensor:
    """Status ``(*B, N)`` int8 of points.

    Args:
        found: the points.
        in_front: of all used views.
        size: largest coordinate or depth.
        largest: what the caller's type can hold.
        enough: at least two views count.
        finite: everything used is.
    """
    status = torch.zeros_like(in_front, dtype=torch.int8)
    for failed, reason in (
        (~in_front, Status.BEHIND_CAMERA),
        (found.at_infinity | ~(size < largest), Status.AT_INFINITY),
        (~found.posed, Status.NO_PARALLAX),
        (~enough, Status.TOO_FEW_VIEWS),
        (~finite, Status.NOT_FINITE_INPUT),
    ):
        status = torch.where(failed, torch.full_like(status, reason), status)
    return status
