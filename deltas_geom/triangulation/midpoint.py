"""Cheap triangulation of bearing rays: the point nearest to their lines.

A 3x3 solve in closed form, without an eigenvector. The plain midpoint measures metres: it trusts
far cameras as much as near ones and, where parallax is small, pulls points towards the cameras.
One more solve at the midpoint, weighted by inverse depth, makes it an angle.
"""

import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import safe_divide
from deltas_geom.numerics.arithmetic import (
    only,
    outside_gradients,
    without_autocast,
    without_gradients,
)
from deltas_geom.numerics.sums import over_views
from deltas_geom.numerics.symmetric3 import inverse3
from deltas_geom.numerics.vectors import Vector3, dot, either, scaled
from deltas_geom.triangulation.bearings import (
    Bearings,
    across,
    across_sums,
    describe_rays,
    see_rays,
)
from deltas_geom.triangulation.judge import judge, ok
from deltas_geom.triangulation.observed import check_observed
from deltas_geom.triangulation.operation import operation
from deltas_geom.triangulation.results import Triangulation
from deltas_geom.triangulation.rig_frame import camera_moments


@without_autocast
def triangulate_midpoint(
    cam_from_world: Tensor,
    rays: Tensor,
    weights: Tensor | None = None,
    mask: Tensor | None = None,
    *,
    covariance: bool = False,
    max_residual: float | None = None,
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
        covariance: also compute that of the least angles, from which midpoints scatter more.
        max_residual: rad; points about which the views disagree by more are RESIDUAL_TOO_LARGE.
            Rays handed over as (N, V, 3) where N = V have residuals of many degrees, too.

    Returns:
        As :func:`triangulate_rays`, in metres along each ray and in rad. Parallax below 3e-7 rad
        counts as none.

    Raises:
        ShapeError: a trailing shape differs, or there is no view.
        TypeError: the mask is not bool.
        ValueError: ``max_residual`` is not positive.

    Source: Szeliski, Computer Vision, 2nd ed., section 11.2.4.

    Example:
        >>> right = torch.eye(4)
        >>> right[0, 3] = -0.2  # 20 cm to the right
        >>> rays = torch.tensor([[[0.1, 0.05, 1.0]], [[0.0, 0.25, 5.0]]])
        >>> result = triangulate_midpoint(torch.stack([torch.eye(4), right]), rays)
        >>> result.points.round(decimals=3)
        tensor([[0.2000, 0.1000, 2.0000]])
    """
    inputs = cam_from_world, rays, weights, mask
    return _triangulate(inputs, False, covariance, max_residual)


@without_autocast
def triangulate_inverse_depth_weighted(
    cam_from_world: Tensor,
    rays: Tensor,
    weights: Tensor | None = None,
    mask: Tensor | None = None,
    *,
    covariance: bool = False,
    max_residual: float | None = None,
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
    inputs = cam_from_world, rays, weights, mask
    return _triangulate(inputs, True, covariance, max_residual)


def _triangulate(
    inputs: tuple[Tensor, Tensor, Tensor | None, Tensor | None],
    stepped: bool,
    covariance: bool,
    max_residual: float | None,
) -> Triangulation:
    cam_from_world, rays, weights, mask = inputs
    check_observed(cam_from_world=cam_from_world, rays=rays, weights=weights, mask=mask)

    def moved(seen: Bearings, points: Vector3, valid: Tensor) -> Vector3:
        return _stepped(seen, points, valid) if stepped else points

    def solve(seen: Bearings) -> tuple[Vector3, Tensor]:
        points, share = _midpoint(seen)
        status = _judge(seen, points, share)
        return moved(seen, points, ok(status)), status

    return operation(
        Triangulation,
        inputs,
        see=see_rays,
        solve=solve,
        follow=lambda seen, _, valid: moved(seen, _midpoint(seen)[0], valid),
        describe=describe_rays,
        dtype=rays.dtype,
        covariance=covariance,
        max_residual=max_residual,
    )


def _midpoint(seen: Bearings) -> tuple[Vector3, Tensor]:
    """The points nearest to the lines, and what :func:`_nearest` says of the directions."""
    zero = torch.zeros_like(seen.datum[..., 0])
    centers = tuple(-part for part in seen.offsets((zero, zero, zero)))
    return _nearest(seen.directions, seen.weights.squared, across(seen.directions, centers))


def _stepped(seen: Bearings, points: Vector3, valid: Tensor) -> Vector3:
    """Points after one step of Gauss-Newton on the sines, where it stays in front."""
    # What has failed passes no gradient and no NaN.
    points = either(valid, points, (0.0,) * 3)
    offset, used = seen.offsets(points), ~seen.weights.unused & valid.unsqueeze(-2)
    squared = torch.where(used, dot(offset, offset), 1.0)
    towards = scaled(offset, squared.rsqrt())
    # The change of a sine: its numerator's, and its denominator's, which is what keeps points
    # from coming nearer only because all distances shrink there.
    target = across(towards, across(seen.directions, offset))
    weight = torch.where(used, seen.weights.squared, 0.0) / squared
    largest = weight.detach().amax(dim=-2, keepdim=True)
    weight = weight / torch.where((largest > 0) & largest.isfinite(), largest, 1.0)
    change, _ = _nearest(towards, weight, target)
    near = tuple(x - by for x, by in zip(points, change, strict=True))
    return either(seen.in_front(near), near, points)


def _nearest(directions: Vector3, weight: Tensor, target: Vector3) -> tuple[Vector3, Tensor]:
    """Minimises the sum of weight |(1 - d d^T) x - target|^2, the target orthogonal to d.

    Also the mean squared sine of the directions to their common one, up to a factor 1 to 3. Where
    it is 0 within rounding x is 0, without gradient.
    """
    c00, c01, c02, c11, c12, c22 = inverse3(across_sums(weight, directions))
    with outside_gradients():
        # The trace of an inverse is at most 3 by the smallest eigenvalue.
        total = (c00 + c11 + c22) * weight.sum(dim=-2)
        share = safe_divide(torch.ones_like(total), total, total > 0)
        definite = share > 64 * torch.finfo(share.dtype).eps
    right = tuple(only((weight * part).sum(dim=-2), definite) for part in target)
    rows = (c00, c01, c02), (c01, c11, c12), (c02, c12, c22)
    return tuple(dot(row, right) for row in rows), only(share, definite)


@without_gradients
def _judge(seen: Bearings, points: Vector3, share: Tensor) -> Tensor:
    """Status ``(*B, N)`` int8 of the midpoints."""
    eps, least = torch.finfo(seen.dtype).eps, 64 * torch.finfo(share.dtype).eps
    _, moments = camera_moments(seen.centers, seen.datum, seen.broken)
    counted = seen.weights.used
    count, *sums = over_views(moments, counted)
    total = count.clamp(min=1)
    square, *middle, size, _ = (part / total for part in sums)
    # Of the cameras, squared, all alike: their spread, and the part of it across the rays.
    reach = square - dot(tuple(middle), tuple(middle))
    along = dot(seen.directions, seen.offsets(tuple(middle))) * counted
    beside = reach - along.square().sum(dim=-2) / total
    # Cameras closer together than the rounding of where they are, or in line with the point.
    posed = reach > (64 * eps) ** 2 * size + least * square
    noise = (8 * eps) ** 2 * (size + reach) + least * reach
    posed = posed & ((beside > noise) | (share * reach > noise))
    # The law of sines: the spread and the distance, without the point, which may be anywhere.
    near = share * reach > (16 * eps) ** 2 * beside.clamp(min=0)
    near = near & torch.stack(points).to(seen.dtype).isfinite().all(dim=0)
    return judge(
        finite=seen.weights.sound,
        enough=count >= 2,
        posed=posed,
        near=near,
        in_front=seen.in_front(points),
    )
