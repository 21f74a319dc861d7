"""Rays as pixels: each is the pixel (0, 0) of a camera of its own, which looks along it.

The camera has a focal length of 1, so that a pixel off by 1e-3 is a ray off by a milliradian. What
is known of pixels (outliers, refinement, covariance) is so known of rays, whose points have a
batch of cameras each.
"""

import math
from typing import Literal

import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import with_one
from deltas_geom.checks import check_positive, check_tensor
from deltas_geom.numerics.arithmetic import (
    at_least_in_single,
    finite_or_zero,
    outside_gradients,
    promoted,
    without_autocast,
)
from deltas_geom.numerics.chunks import Cut
from deltas_geom.numerics.evaluation import in_chunks
from deltas_geom.numerics.vectors import dot
from deltas_geom.triangulation.bearings import Bearings, angles_of, see_rays
from deltas_geom.triangulation.observed import check_observed
from deltas_geom.triangulation.rays import triangulate_rays
from deltas_geom.triangulation.refine import Refined, refine_points
from deltas_geom.triangulation.reprojection import mean_of
from deltas_geom.triangulation.results import RobustTriangulation, of_inliers
from deltas_geom.triangulation.robust import triangulate_robust
from deltas_geom.triangulation.robust_loss import Loss
from deltas_geom.triangulation.solution import kept
from deltas_geom.triangulation.uncertainty import point_covariance, representable

_CHUNK = 2048  # points whose outliers are looked for at a time


@without_autocast
def triangulate_robust_rays(
    cam_from_world: Tensor,
    rays: Tensor,
    weights: Tensor | None = None,
    mask: Tensor | None = None,
    *,
    threshold: float = 0.01,
    min_inliers: int = 2,
    max_pairs: int = 64,
    covariance: bool = False,
) -> RobustTriangulation:
    """:func:`triangulate_robust` of rays: find the views that are wrong about each point.

    Args:
        cam_from_world: ``(*B, V, 4, 4)`` rigid.
        rays: ``(*B, V, N, 3)`` in each camera's frame, of any length but 0; z may be negative.
            Those of unused views may hold anything. Handed over as (N, V, 3) where N = V they
            leave hardly an inlier.
        weights: ``(*B, V, N)``, 0 = unused; a sign has no effect. Large ones are rejected last.
        mask: ``(*B, V, N)`` bool, True = used.
        threshold: rad, less than a right angle: beyond it a view is an outlier. 4 px of a focal
            length of 400 px are 0.01 rad.
        min_inliers: fewest views that must agree, 2 or more.
        max_pairs: most pairs tried for a point.
        covariance: also compute the covariance of the points.

    Returns:
        What :func:`triangulate_rays` says of the inliers, in angles; all else is as there.

    Raises:
        ShapeError, TypeError: a trailing shape differs, there is no view, the mask is not bool.
        ValueError: a threshold out of range, ``min_inliers`` below 2, no pairs.

    Source: as of :func:`triangulate_robust`.

    Example:
        >>> poses = torch.eye(4).repeat(4, 1, 1)
        >>> poses[:, 0, 3] = torch.tensor([0.0, -0.2, -0.4, -0.6])  # 20 cm to the right, each
        >>> rays = torch.tensor([[0.1, 0.05, 1], [0, 0.05, 1], [0.4, -0.3, 1], [-0.2, 0.05, 1]])
        >>> result = triangulate_robust_rays(poses, rays[:, None])
        >>> result.inliers[:, 0].tolist(), result.points.round(decimals=3)
        ([True, True, False, True], tensor([[0.2000, 0.1000, 2.0000]]))
    """
    check_observed(cam_from_world=cam_from_world, rays=rays, weights=weights, mask=mask)
    if not 0 < threshold < math.pi / 2:
        raise ValueError(f"threshold must be positive and below pi / 2, got {threshold}")

    def agreeing(rays: Tensor, *weighed: Tensor | None) -> tuple[Tensor, Tensor]:
        cameras = _aimed(see_rays(cam_from_world, rays, None, None))
        found = triangulate_robust(
            cameras,
            _pixels_of(cameras),
            *map(_alone, weighed),
            threshold=math.tan(threshold),
            min_inliers=min_inliers,
            max_pairs=max_pairs,
        )
        return found.inliers.squeeze(-1).mT, found.status.squeeze(-1)

    with outside_gradients():
        cut = Cut(_CHUNK, (-2, -1, -1), (-1, -1))
        inliers, reason = in_chunks(agreeing, cut, rays, weights, mask)
    points = triangulate_rays(cam_from_world, rays, weights, inliers, covariance=covariance)
    return of_inliers(points, inliers, reason)


@without_autocast
def refine_rays(
    cam_from_world: Tensor,
    rays: Tensor,
    points: Tensor,
    weights: Tensor | None = None,
    mask: Tensor | None = None,
    *,
    steps: int = 1,
    loss: Loss = "squared",
    scale: float = 0.01,
    gradient: Literal["unrolled", "implicit"] = "unrolled",
) -> Refined:
    """:func:`refine_points` for rays: move points so that they come closer to these.

    What becomes small are the tangents of the angles: a point at a right angle to a used ray, or
    behind it, is not valid.

    Args:
        cam_from_world: ``(*B, V, 4, 4)`` rigid.
        rays: ``(*B, V, N, 3)`` in each camera's frame, of any length but 0; z may be negative.
            Those of unused views may hold anything.
        points: ``(*B, N, 3)`` in the world, metres: where to start.
        weights: ``(*B, V, N)`` not negative (a sign has no effect). 0 = unused. Ratios count.
        mask: ``(*B, V, N)`` bool, True = used.
        steps: of Gauss-Newton. 0 judges the points without moving them.
        loss: "squared", "huber" (linear beyond ``scale``) or "cauchy" (logarithmic).
        scale: rad, the angle of a view at which a robust loss begins to doubt it.
        gradient: see :func:`refine_points`.

    Returns:
        Points, weighted RMS angle (rad; large also of rays (N, V, 3), N = V), could they be
        refined?

    Raises:
        ShapeError, TypeError: a trailing shape differs, there is no view, the mask is not bool.
        ValueError: unknown loss or gradient, negative number of steps, scale not positive.

    Source: as of :func:`refine_points`.
    """
    check_observed(
        cam_from_world=cam_from_world, rays=rays, points=points, weights=weights, mask=mask
    )
    check_positive(scale=scale)
    seen = see_rays(cam_from_world, rays, weights, mask)
    cameras = _aimed(seen)
    found = refine_points(
        cameras,
        _pixels_of(cameras),
        points.unsqueeze(-2),
        _alone(weights),
        _alone(mask),
        steps=steps,
        loss=loss,
        scale=scale,
        gradient=gradient,
    )
    place, valid = found.points.squeeze(-2), found.valid.squeeze(-1)
    x, y, z = (place.to(cameras.dtype) - seen.datum).unbind(dim=-1)
    near, used = kept((x, y, z), valid), ~seen.weights.unused & valid.unsqueeze(-2)
    _, angle = angles_of(seen, seen.offsets(near), used)
    residual = mean_of(angle.square(), used, seen.weights.squared)
    return Refined(place, residual.to(points.dtype), valid)


@at_least_in_single
def ray_covariance(
    cam_from_world: Tensor,
    points: Tensor,
    weights: Tensor,
    *,
    mask: Tensor | None = None,
    pose_covariance: Tensor | None = None,
) -> Tensor:
    """:func:`point_covariance` for rays that are off by a standard deviation of 1 / weight rad.

    Args:
        cam_from_world: ``(*B, V, 4, 4)`` rigid.
        points: ``(*B, N, 3)`` in the world, metres; in front of and behind cameras.
        weights: ``(*B, V, N)``; 0 = unused, as is less than a millionth of the point's largest.
            (N, V) goes unnoticed where N = V: with one point left out it is an error.
        mask: ``(*B, V, N)`` bool, True = used.
        pose_covariance: ``(*B, V, 6, 6)`` of centres (m) and rotation vectors (rad).

    Returns:
        ``(*B, N, 3, 3)`` m^2, in float32 at least; all else is as there.

    Raises:
        ShapeError: a trailing shape differs, batch dims do not broadcast, or there is no view.
        TypeError: an argument is not floating point, or the mask not bool.

    Source: as of :func:`point_covariance`.
    """
    check_tensor(weights=weights)
    check_observed(cam_from_world=cam_from_world, points=points, weights=weights, mask=mask)
    poses, place = promoted(cam_from_world[..., :3, :], points)
    # What is not finite has a ray of length 0, so that it is told, and passes no gradient.
    (near, _), (rows, _) = finite_or_zero(place), finite_or_zero(poses, dims=2)
    rays = with_one(near).unsqueeze(-3) @ rows.mT
    found = point_covariance(
        _aimed(see_rays(cam_from_world, rays, None, None)),
        points.unsqueeze(-2),
        weights.mT.unsqueeze(-1),
        mask=_alone(mask),
        pose_covariance=None if pose_covariance is None else pose_covariance.unsqueeze(-4),
    )
    return representable(found[..., 0, :, :], poses.dtype)


def _aimed(seen: Bearings) -> Tensor:
    """The cameras ``(*B, N, V, 3, 4)`` of rays; NaN where these are not sound.

    Source: Duff et al., Building an Orthonormal Basis, Revisited (JCGT 2017).
    """
    x, y, z = seen.directions
    side = torch.where(z < 0, -1.0, 1.0)
    share = -1 / (side + z)
    both = x * y * share
    c0, c1, c2 = seen.centers.unsqueeze(-1).unbind(dim=-2)

    def row(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
        return torch.stack([a, b, c, -dot((a, b, c), (c0, c1, c2))], dim=-1)

    rows = (
        row(1 + side * x * x * share, side * both, -side * x),
        row(both, side + y * y * share, -y),
        row(x, y, z),
    )
    cameras = torch.stack(rows, dim=-2)  # (*B, V, N, 3, 4)
    return torch.where(seen.sound[..., None, None], cameras, torch.nan).transpose(-4, -3)


def _pixels_of(cameras: Tensor) -> Tensor:
    """``(V, 1, 2)``: where each of them sees its ray."""
    return cameras.new_zeros(cameras.shape[-3], 1, 2)


def _alone(values: Tensor | None) -> Tensor | None:
    """Of points ``(*B, V, N)``, as of one point in each batch item: ``(*B, N, V, 1)``."""
    return None if values is None else values.mT.unsqueeze(-1)
