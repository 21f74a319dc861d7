"""Outliers, refinement and covariance of tracks: those of pixels, by groups of tracks.

Each group is a batch of points with cameras of their own (track_groups.py). Groups depend on where
indices lead: unlike triangulate_tracks, these functions have no graph that compilers could keep.
"""

from functools import partial
from typing import Literal

import torch
from torch import Tensor

from deltas_geom.checks import check_tensor
from deltas_geom.numerics.arithmetic import at_least_in_single, outside_gradients, without_autocast
from deltas_geom.triangulation.refine import Refined, refine_points
from deltas_geom.triangulation.robust import triangulate_robust
from deltas_geom.triangulation.robust_loss import Loss
from deltas_geom.triangulation.track_groups import check_tracks, grouped, rows_at, seen_by
from deltas_geom.triangulation.tracks import TriangulatedTracks, triangulate_tracks
from deltas_geom.triangulation.uncertainty import point_covariance


@without_autocast
def triangulate_robust_tracks(
    proj: Tensor,
    pixels: Tensor,
    camera_index: Tensor,
    point_index: Tensor,
    num_points: int,
    weights: Tensor | None = None,
    *,
    threshold: float = 4.0,
    min_inliers: int = 2,
    max_pairs: int = 64,
    covariance: bool = False,
) -> TriangulatedTracks:
    """:func:`triangulate_robust` of tracks: find the observations that are wrong.

    Where indices lead is read: no graph is compiled of it, and a GPU is waited for. So do
    :func:`refine_tracks` and :func:`track_covariance`.

    Args:
        proj: ``(C, 3, 4)`` K [R | t].
        pixels: ``(T, 2)``; those of unused observations may hold anything.
        camera_index: ``(T)`` integers, 0 to C - 1.
        point_index: ``(T)`` integers, 0 to N - 1.
        num_points: N. A point without observations has the status TOO_FEW_VIEWS.
        weights: ``(T)``, 0 = unused; a sign has no effect. Large ones are rejected last.
        threshold: px, the distance beyond which an observation is an outlier.
        min_inliers: fewest observations that must agree, 2 or more.
        max_pairs: most pairs tried for a point.
        covariance: also compute the covariance of the points.

    Returns:
        What :func:`triangulate_tracks` says of the inliers, which ``used`` tells: none if a point
        is not valid. All else is as of :func:`triangulate_robust`; the order of observations does
        not count. Camera indices that were mixed up leave few inliers.

    Raises:
        ShapeError, TypeError: a shape differs, an index is not of integers.
        ValueError: a threshold that is not positive, ``min_inliers`` below 2, no pairs, or a
            negative ``num_points``.
        IndexError: an index is out of range.

    Source: as of :func:`triangulate_robust`.

    Example:
        >>> proj = torch.tensor([[100.0, 0, 50, 0], [0, 100, 40, 0], [0, 0, 1, 0]]).repeat(4, 1, 1)
        >>> proj[:, 0, 3] = torch.tensor([0.0, -20, -40, -60])  # 20 cm to the right, each
        >>> pixels = torch.tensor([[60.0, 45], [50, 45], [90, 10], [30, 45]])
        >>> tracks = triangulate_robust_tracks(
        ...     proj, pixels, torch.arange(4), torch.zeros(4).long(), num_points=1
        ... )
        >>> tracks.used.tolist(), tracks.points.round(decimals=3)
        ([True, True, False, True], tensor([[0.2000, 0.1000, 2.0000]]))
    """
    check_tracks(proj, camera_index, point_index, weights, pixels=pixels, num_points=num_points)
    weights = torch.ones_like(pixels[..., 0]) if weights is None else weights
    groups = grouped(camera_index, point_index, len(proj), num_points)
    robust = partial(
        triangulate_robust, threshold=threshold, min_inliers=min_inliers, max_pairs=max_pairs
    )
    with outside_gradients():
        seen = (seen_by(group, proj, camera_index, weights, pixels) for group in groups.groups)
        found = [robust(cameras, xy, weight) for cameras, weight, xy in seen]
        inliers = groups.observations([one.inliers.squeeze(-1) for one in found])
        reason = groups.points([one.status.squeeze(-1) for one in found])
        agreed = groups.points([one.inliers.squeeze(-1).any(dim=-1) for one in found])
    tracks = triangulate_tracks(
        proj,
        pixels,
        camera_index,
        point_index,
        num_points,
        torch.where(inliers, weights, 0.0),
        covariance=covariance,
    )
    status = torch.where(agreed, tracks.status, reason)
    used = inliers & rows_at(tracks.valid, point_index)
    return tracks._replace(status=status, used=used)


@without_autocast
def refine_tracks(
    proj: Tensor,
    pixels: Tensor,
    points: Tensor,
    camera_index: Tensor,
    point_index: Tensor,
    weights: Tensor | None = None,
    *,
    steps: int = 1,
    loss: Loss = "squared",
    scale: float = 1.0,
    gradient: Literal["unrolled", "implicit"] = "unrolled",
) -> Refined:
    """:func:`refine_points` of tracks: move points closer to their own observations.

    Args:
        proj: ``(C, 3, 4)`` K [R | t].
        pixels: ``(T, 2)``; those of unused observations may hold anything.
        points: ``(N, 3)`` in the world, metres: where to start.
        camera_index: ``(T)`` integers, 0 to C - 1.
        point_index: ``(T)`` integers, 0 to N - 1.
        weights: ``(T)`` not negative (a sign has no effect). 0 = unused. Ratios count.
        steps: of Gauss-Newton. 0 judges the points without moving them.
        loss: "squared", "huber" (linear beyond ``scale``) or "cauchy" (logarithmic).
        scale: px, the distance of an observation at which a robust loss begins to doubt it.
        gradient: see :func:`refine_points`.

    Returns:
        Points ``(N, 3)``, weighted RMS distance ``(N)`` px (large also where indices were mixed
        up), could they be refined?

    Raises:
        ShapeError, TypeError: a shape differs, an index is not of integers.
        ValueError: unknown loss or gradient, negative number of steps, scale not positive.
        IndexError: an index is out of range.

    Source: as of :func:`refine_points`.
    """
    check_tracks(proj, camera_index, point_index, weights, pixels=pixels, points=points)
    weights = torch.ones_like(pixels[..., 0]) if weights is None else weights
    groups = grouped(camera_index, point_index, len(proj), len(points))
    refined = partial(refine_points, steps=steps, loss=loss, scale=scale, gradient=gradient)
    found = []
    for group in groups.groups:
        cameras, weight, seen = seen_by(group, proj, camera_index, weights, pixels)
        start = points.index_select(0, group.points).unsqueeze(-2)
        found.append(refined(cameras, seen, start, weight))
    return Refined(
        *(groups.points([part.squeeze(1) for part in parts]) for parts in zip(*found, strict=True))
    )


@at_least_in_single
def track_covariance(
    proj: Tensor,
    points: Tensor,
    camera_index: Tensor,
    point_index: Tensor,
    weights: Tensor,
    *,
    pose_covariance: Tensor | None = None,
) -> Tensor:
    """:func:`point_covariance` of tracks, for pixel noise of 1 / weight px.

    Args:
        proj: ``(C, 3, 4)``.
        points: ``(N, 3)`` in the world, metres.
        camera_index: ``(T)`` integers, 0 to C - 1.
        point_index: ``(T)`` integers, 0 to N - 1.
        weights: ``(T)``; 0 = unused, as is less than a millionth of the point's largest.
        pose_covariance: ``(C, 6, 6)`` of centres (m) and rotation vectors (rad). Two observations
            of a point by one camera count as independent.

    Returns:
        ``(N, 3, 3)`` m^2; all else is as there.

    Raises:
        ShapeError: a shape differs.
        TypeError: an index is not of integers, or another argument not floating point.
        IndexError: an index is out of range.

    Source: as of :func:`point_covariance`.
    """
    check_tensor(weights=weights)
    check_tracks(
        proj, camera_index, point_index, weights, points=points, pose_covariance=pose_covariance
    )
    groups = grouped(camera_index, point_index, len(proj), len(points))
    found = []
    for group in groups.groups:
        cameras, weight = seen_by(group, proj, camera_index, weights)
        noise = None
        if pose_covariance is not None and len(camera_index):
            noise = rows_at(pose_covariance, camera_index[group.places])
        place = points.index_select(0, group.points).unsqueeze(-2)
        found.append(point_covariance(cameras, place, weight, pose_covariance=noise))
    return groups.points([part.squeeze(1) for part in found])
