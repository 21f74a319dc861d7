"""Cheap triangulation of bearing rays: the point nearest to their lines.

A 3x3 solve in closed form, without an eigenvector. The plain midpoint measures metres: it trusts
far cameras as much as near ones and, where parallax is small, pulls points towards the cameras.
One more solve at the midpoint, weighted by inverse depth, makes it an angle.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import safe_divide, safe_sqrt
from deltas_geom.checks import batch_shape, check_floating, check_shapes
from deltas_geom.numerics.arithmetic import solver_dtype, without_autocast
from deltas_geom.numerics.chunks import cut_points
from deltas_geom.numerics.evaluation import recomputed
from deltas_geom.status import Status
from deltas_geom.triangulation.judge import judge
from deltas_geom.triangulation.reprojection import parallax_of
from deltas_geom.triangulation.results import Triangulation
from deltas_geom.triangulation.weights import NEGLIGIBLE_WEIGHT, check_weights

_Vector = tuple[Tensor, ...]
"""Three components, each of any shape."""


@without_autocast
def triangulate_midpoint(
    cam_from_world: Tensor, rays: Tensor, weights: Tensor | None = None, mask: Tensor | None = None
) -> Triangulation:
    """The point nearest to the lines of matched rays of V posed views, differentiably.

    Fit for parallax well above the noise of the rays. With less, points come out too near: by
    10 % in four views when the parallax of 1 degree is nine times the noise.

    Args:
        cam_from_world: ``(*B, V, 4, 4)`` rigid.
        rays: ``(*B, V, N, 3)`` in each camera's frame, of any length but 0; z may be negative.
            Those of unused views may hold anything.
        weights: ``(*B, V, N)`` not negative (a sign has no effect) of the distances, whose
            squares are summed. 0 = unused.
        mask: ``(*B, V, N)`` bool, True = used.

    Returns:
        As :func:`triangulate_rays`: ``depth`` along each ray, metres; ``residual`` the weighted
        RMS angle, rad; ``covariance`` None. Parallax below 3e-7 rad counts as none.

    Raises:
        ShapeError: a trailing shape differs, or there is no view.
        TypeError: the mask is not bool.

    Source: Szeliski, Computer Vision, 2nd ed., section 11.2.4.

    Example:
        >>> right = torch.eye(4)
        >>> right[0, 3] = -0.2  # 20 cm to the right
        >>> rays = torch.tensor([[[0.1, 0.05, 1.0]], [[0.0, 0.25, 5.0]]])
        >>> result = triangulate_midpoint(torch.stack([torch.eye(4), right]), rays)
        >>> result.points.round(decimals=3)
        tensor([[0.2000, 0.1000, 2.0000]])
    """
    return _triangulate(cam_from_world, rays, weights, mask, stepped=False)


@without_autocast
def triangulate_inverse_depth_weighted(
    cam_from_world: Tensor, rays: Tensor, weights: Tensor | None = None, mask: Tensor | None = None
) -> Triangulation:
    """The midpoint, moved by one step that weighs each view by its inverse depth.

    A distance from a ray's line divided by depth is the sine of an angle: the step is that of
    Gauss-Newton on the sum of their squares. Lee and Civera weigh by inverse depth in two views;
    this holds for any number. It takes the derivative of the depth into account, without which
    the points would stay too near. A step that ends behind a used camera is not taken.

    Arguments, returns and raises are those of :func:`triangulate_midpoint`, but for the weights,
    which are of the angles.

    Source: Lee and Civera, Triangulation: Why Optimize? (BMVC 2019), for the weights.

    Example:
        >>> near = torch.eye(4)
        >>> near[0, 3], near[2, 3] = -0.2, -1.5  # 20 cm to the right and 1.5 m ahead
        >>> rays = torch.tensor([[[0.1, 0.002, 1.0]], [[0.0, 0.0, 0.5]]])  # 4 mm apart at 2 m
        >>> poses = torch.stack([torch.eye(4), near])
        >>> triangulate_midpoint(poses, rays).points[..., :2].round(decimals=4)
        tensor([[0.2000, 0.0020]])
        >>> triangulate_inverse_depth_weighted(poses, rays).points[..., :2].mul(1e3).round()
        tensor([[200., 0.]])
    """
    return _triangulate(cam_from_world, rays, weights, mask, stepped=True)


def _triangulate(
    cameras: Tensor, rays: Tensor, weights: Tensor | None, mask: Tensor | None, *, stepped: bool
) -> Triangulation:
    check_shapes(cam_from_world=(cameras, "+V 4 4"), rays=(rays, "V N 3"))
    check_floating(cam_from_world=cameras, rays=rays)
    check_weights(weights, mask, "rays", rays, "V N 3", cameras.shape[:-3])
    dtype = rays.dtype

    def solve(*inputs: Tensor) -> tuple[Tensor, ...]:
        seen = _see(*inputs)
        weight = torch.where(seen.used, seen.squared, 0.0)
        across = _across(seen.directions, seen.centers[..., None].unbind(dim=-2))
        points, share = _nearest(seen.directions, weight, across)
        status = _judge(seen, points, share, dtype)
        valid = status == Status.OK.value
        # Of what has failed nothing is used: it passes no gradient and no NaN.
        seen = seen._replace(used=seen.used & valid.unsqueeze(-2))
        x, y, z = (torch.where(valid, component, 0.0) for component in points)
        if stepped:
            x, y, z = _stepped(seen, (x, y, z))
        along, squared_angle = _fit(seen, (x, y, z))
        weight = torch.where(seen.used, seen.squared, 0.0)
        mean = safe_divide((weight * squared_angle).sum(dim=-2), weight.sum(dim=-2), valid)
        found = (
            torch.where(valid[..., None], torch.stack([x, y, z], dim=-1) + seen.around, 0.0),
            torch.where(valid.unsqueeze(-2), along, 0.0),
            safe_sqrt(mean),
            parallax_of(seen.centers, (x, y, z), seen.used.to(along.dtype)),
        )
        limit = torch.finfo(dtype).max
        return (*(value.to(dtype).clamp(-limit, limit) for value in found), status)

    cut = cut_points(rays, -2, -1, -1, outputs=(-2, -1, -1, -1, -1))
    found = recomputed(solve, cameras, rays, weights, mask, cut=cut)
    points, depth, residual, parallax, status = found
    valid = status == Status.OK.value
    return Triangulation(
        points, depth, status, valid, residual, parallax, None, torch.zeros_like(depth)
    )


class _Seen(NamedTuple):
    """The inputs in the solver's type, broadcast, with everything unusable replaced.

    Attributes:
        around: ``(*B, 1, 3)`` the origin of what follows, near the cameras.
        centers: ``(*B, V, 3)`` of the cameras.
        directions: three ``(*B, V, N)`` unit; any where unused.
        squared: ``(*B, V, N)`` squared weights, a point's largest 1.
        used: ``(*B, V, N)`` bool.
        finite: ``(*B, N)`` bool: everything used is, and every used ray has a direction.
    """

    around: Tensor
    centers: Tensor
    directions: _Vector
    squared: Tensor
    used: Tensor
    finite: Tensor


def _see(cameras: Tensor, rays: Tensor, weights: Tensor | None, mask: Tensor | None) -> _Seen:
    work = solver_dtype(rays)
    pose, ray = cameras.to(work), rays.mT.to(work).contiguous()
    weight = ray.new_ones(()) if weights is None else weights.to(work)
    if mask is not None:
        weight = torch.where(mask, weight, 0.0)
    shapes = (pose.shape[:-3], ray.shape[:-3], weight.shape[:-2])
    weight = weight.expand(*batch_shape(*shapes), ray.shape[-3], ray.shape[-1])
    with torch.no_grad():
        # Squares of what is let through can be represented. NaN is not let through.
        posed = (pose[..., :3, :].abs() < torch.finfo(work).max ** 0.25).all(-1).all(-1)
        size, length = weight.abs(), ray.abs().amax(dim=-2)
        largest = size.amax(dim=-2, keepdim=True)
        used = ~(size <= NEGLIGIBLE_WEIGHT * largest)
        known = posed[..., None] & (length > 0) & length.isfinite()
    # Double where throughout: what is not used must pass no gradient and no NaN.
    pose = torch.where(posed[..., None, None], pose, 0.0)
    # Divided by its largest coordinate it cannot overflow when squared.
    ray = torch.where(known.unsqueeze(-2), ray, 1.0)
    ray = ray / torch.where(known, length, 1.0).unsqueeze(-2)
    x, y, z = (pose[..., :3, :3].mT @ ray).unbind(dim=-2)
    square = x * x + y * y + z * z
    # A pose that is no rotation may turn a ray into nothing.
    known = known & (square.detach() > torch.finfo(work).tiny ** 0.4)
    inverse = torch.where(known, square, 1.0).rsqrt()
    finite = ((known & size.isfinite()) | ~used).all(dim=-2) & largest.isfinite().squeeze(-2)
    used = used & finite.unsqueeze(-2)
    centers = -(pose[..., :3, :3].mT @ pose[..., :3, 3:]).squeeze(-1)  # whatever the last row
    seen = used.any(dim=-1)[..., None]
    around = torch.where(seen, centers.detach(), 0.0).sum(dim=-2, keepdim=True)
    around = around / seen.sum(dim=-2, keepdim=True).clamp(min=1)
    share = torch.where(used, weight, 0.0) / torch.where(used, largest, 1.0)
    directions = (x * inverse, y * inverse, z * inverse)
    return _Seen(around, centers - around, directions, share.square(), used, finite)


def _stepped(seen: _Seen, points: _Vector) -> _Vector:
    """Points after one step of Gauss-Newton on the sines, where it stays in front."""
    offset = _offset(seen, points)
    squared = torch.where(seen.used, _dot(offset, offset), 1.0)
    inverse = squared.rsqrt()
    towards = tuple(component * inverse for component in offset)
    # The change of a sine: its numerator's, and its denominator's, which is what keeps points
    # from coming nearer only because all distances shrink there.
    target = _across(towards, _across(seen.directions, offset))
    weight = torch.where(seen.used, seen.squared, 0.0) / squared
    largest = weight.detach().amax(dim=-2, keepdim=True)
    weight = weight / torch.where((largest > 0) & largest.isfinite(), largest, 1.0)
    change, _ = _nearest(towards, weight, target)
    moved = tuple(old - step for old, step in zip(points, change, strict=True))
    good = _in_front(seen, moved)
    return tuple(torch.where(good, new, old) for new, old in zip(moved, points, strict=True))


def _nearest(directions: _Vector, weight: Tensor, target: _Vector) -> tuple[_Vector, Tensor]:
    """Minimises the sum of weight |(1 - d d^T) x - target|^2, the target orthogonal to d.

    Also the mean squared sine of the directions to their common one, up to a factor 1 to 3. Where
    it is 0 within rounding x is any finite vector, and its gradient is finite.
    """
    d0, d1, d2 = directions
    v0, v1, v2 = weight * d0, weight * d1, weight * d2
    n00, n01, n02 = ((weight - v0 * d0).sum(-2), -(v0 * d1).sum(-2), -(v0 * d2).sum(-2))
    n11, n12, n22 = (weight - v1 * d1).sum(-2), -(v1 * d2).sum(-2), (weight - v2 * d2).sum(-2)
    c00, c01, c02 = n11 * n22 - n12 * n12, n02 * n12 - n01 * n22, n01 * n12 - n02 * n11
    c11, c12, c22 = n00 * n22 - n02 * n02, n01 * n02 - n00 * n12, n00 * n11 - n01 * n01
    determinant = n00 * c00 + n01 * c01 + n02 * c02
    with torch.no_grad():
        total = (c00 + c11 + c22) * weight.sum(dim=-2)
        share = safe_divide(determinant, total, total > 0)
        definite = share > 64 * torch.finfo(share.dtype).eps
    safe = torch.where(definite, determinant, 1.0)
    r0, r1, r2 = ((weight * component).sum(dim=-2) / safe for component in target)
    nearest = (
        c00 * r0 + c01 * r1 + c02 * r2,
        c01 * r0 + c11 * r1 + c12 * r2,
        c02 * r0 + c12 * r1 + c22 * r2,
    )
    return nearest, torch.where(definite, share, 0.0)


def _offset(seen: _Seen, points: _Vector) -> _Vector:
    centers = seen.centers[..., None].unbind(dim=-2)
    return tuple(x.unsqueeze(-2) - c for x, c in zip(points, centers, strict=True))


def _dot(a: _Vector, b: _Vector) -> Tensor:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _across(directions: _Vector, vector: _Vector) -> _Vector:
    """The part of a vector orthogonal to the unit directions."""
    along = _dot(directions, vector)
    return tuple(part - d * along for part, d in zip(vector, directions, strict=True))


@torch.no_grad()
def _in_front(seen: _Seen, points: _Vector) -> Tensor:
    """Is each point ahead on all its used rays, by more than rounding? ``(*B, N)``"""
    offset = _offset(seen, points)
    rounding = 64 * torch.finfo(seen.squared.dtype).eps
    ahead = _dot(seen.directions, offset) > rounding * _dot(offset, offset).sqrt()
    return (ahead | ~seen.used).all(dim=-2)


def _fit(seen: _Seen, points: _Vector) -> tuple[Tensor, Tensor]:
    """Distances along the rays, and squared angles from them, 0 where unused, ``(*B, V, N)``."""
    offset = _offset(seen, points)
    along, across = _dot(seen.directions, offset), _across(seen.directions, offset)
    squared = _dot(across, across)
    apart = seen.used & (squared > 0)
    # sqrt and atan2 have no slope at a perfect match; the gradient there is taken as 0.
    sine = torch.where(apart, torch.where(apart, squared, 1.0).sqrt(), 0.0)
    return along, torch.atan2(sine, torch.where(seen.used, along, 1.0)).square()


@torch.no_grad()
def _judge(seen: _Seen, points: _Vector, share: Tensor, dtype: torch.dtype) -> Tensor:
    """Status ``(*B, N)`` int8 of the midpoints."""
    eps, least = torch.finfo(dtype).eps, 64 * torch.finfo(share.dtype).eps
    square = seen.centers.square().sum(dim=-1, keepdim=True)
    from_world = (seen.centers + seen.around).square().sum(dim=-1, keepdim=True)
    moments = torch.cat([torch.ones_like(square), square, from_world, seen.centers], dim=-1).mT
    counted = seen.used.to(share.dtype)
    count, *sums = (moments @ counted).unbind(dim=-2)
    square, size, *middle = torch.stack(sums) / count.clamp(min=1)
    # Of the cameras, squared, all alike: their spread, and the part of it across the rays.
    reach = square - _dot(tuple(middle), tuple(middle))
    along = _dot(seen.directions, _offset(seen, tuple(middle))) * counted
    beside = reach - along.square().sum(dim=-2) / count.clamp(min=1)
    # Cameras closer together than the rounding of where they are, or in line with the point.
    posed = reach > (64 * eps) ** 2 * size + least * square
    noise = (8 * eps) ** 2 * (size + reach) + least * reach
    posed = posed & ((beside > noise) | (share * reach > noise))
    # The law of sines: the spread and the distance, without the point, which may be anywhere.
    near = share * reach > (16 * eps) ** 2 * beside.clamp(min=0)
    near = near & torch.stack(points).to(dtype).isfinite().all(dim=0)
    return judge(
        finite=seen.finite,
        enough=count >= 2,
        posed=posed,
        near=near,
        in_front=_in_front(seen, points),
    )
