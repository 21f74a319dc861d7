"""Triangulation of ragged tracks: many cameras, each point seen by few of them.

What :func:`triangulate` does over a dense V x N, here as one list of observations, each summed
into its point's normal matrix. Memory grows with the observations alone.
"""

from functools import partial

import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import safe_divide, safe_sqrt
from deltas_geom.numerics.arithmetic import values_at_hand, without_autocast, without_gradients
from deltas_geom.records import Record
from deltas_geom.status import Status
from deltas_geom.triangulation.operation import operation
from deltas_geom.triangulation.reprojection import angle_of, projected, squared_errors
from deltas_geom.triangulation.results import beyond, within_residual, without
from deltas_geom.triangulation.solution import Solution, follow_linear, in_world, kept, solve_linear
from deltas_geom.triangulation.track_equations import (
    PosedTracks,
    at,
    pose_tracks,
    project_listed,
    summed,
    summed_squares,
)
from deltas_geom.triangulation.track_groups import check_range, check_tracks
from deltas_geom.triangulation.uncertainty import inverse_information, unscaled


class TriangulatedTracks(Record):
    """Triangulated points and what is known about them.

    Attributes:
        points: ``(N, 3)`` in the world, metres; (0, 0, 0) with zero gradient if not valid.
        depth: ``(T)`` of each observation's point along its camera's z axis, metres; 0 if the
            point is not valid.
        status: ``(N)`` int8 of :class:`Status`.
        valid: ``(N)`` bool, status is OK.
        residual: ``(N)`` weighted RMS distance of the projections from the pixels, px.
        errors: ``(T)`` distance of each used observation's projection from its pixel, px; 0 where
            unused or the point is not valid.
        parallax: ``(N)`` angle between the rays of two used observations that are far apart, rad,
            of the largest at least half; the largest itself where there are up to three, and mostly
            where there are more. Its cost is that of the list, not of pairs.
        covariance: ``(N, 3, 3)`` for pixel noise of standard deviation 1 / weight px, m^2; None
            unless asked for; 0 if not valid.
        point_index: ``(T)`` of the observations, as given.
        used: ``(T)`` bool: the observation's weight counts.
    """

    points: Tensor
    depth: Tensor
    status: Tensor
    valid: Tensor
    residual: Tensor
    errors: Tensor
    parallax: Tensor
    covariance: Tensor | None
    point_index: Tensor
    used: Tensor

    within_residual = within_residual

    def within_depth(self, depth_range: tuple[float, float]) -> "TriangulatedTracks":
        """As :meth:`Triangulation.within_depth`, the range being that of all used observations."""
        outside = (beyond(self.depth, depth_range) & self.used).to(self.depth.dtype)
        outside = summed(outside, self.point_index, len(self.valid)) > 0
        return without(self, outside, Status.OUT_OF_RANGE)


@without_autocast
def triangulate_tracks(
    proj: Tensor,
    pixels: Tensor,
    camera_index: Tensor,
    point_index: Tensor,
    num_points: int,
    weights: Tensor | None = None,
    *,
    covariance: bool = False,
    max_residual: float | None = None,
) -> TriangulatedTracks:
    """Triangulate N points from T observations by C cameras, differentiably.

    The answer is that of :func:`triangulate` with the tracks padded. The order of observations
    does not count. Two observations of a point by one camera are two views without a baseline.

    Args:
        proj: ``(C, 3, 4)`` K [R | t].
        pixels: ``(T, 2)``; those of unused observations may hold anything.
        camera_index: ``(T)`` integers, 0 to C - 1.
        point_index: ``(T)`` integers, 0 to N - 1.
        num_points: N. A point without observations has the status TOO_FEW_VIEWS.
        weights: ``(T)`` not negative (a sign has no effect). 0 = unused.
        covariance: also compute the covariance of the points.
        max_residual: px; points about which the cameras disagree by more are RESIDUAL_TOO_LARGE.
            Indices of cameras and points that were swapped have residuals of many pixels, too.

    Returns:
        Points with status. Nothing raises or turns NaN because of pixels, weights or cameras.

    Raises:
        ShapeError: a shape differs.
        TypeError: an index is not of integers.
        ValueError: ``num_points`` is negative, or ``max_residual`` not positive.
        IndexError: an index is out of range. (On a GPU torch tells, later, or ends the process:
            check lists of unknown origin before they go there.)

    Source: Hartley and Zisserman, 2nd ed., section 12.2.

    Example:
        >>> left = torch.tensor([[100.0, 0, 50, 0], [0, 100, 40, 0], [0, 0, 1, 0]])
        >>> right = left.clone()
        >>> right[0, 3] = -20.0  # 20 cm to the right
        >>> tracks = triangulate_tracks(
        ...     torch.stack([left, right]),
        ...     pixels=torch.tensor([[60.0, 45.0], [50.0, 45.0], [7.0, 7.0]]),
        ...     camera_index=torch.tensor([0, 1, 0]),
        ...     point_index=torch.tensor([0, 0, 1]),
        ...     num_points=2,
        ... )
        >>> tracks.points.round(decimals=3)
        tensor([[0.2000, 0.1000, 2.0000],
                [0.0000, 0.0000, 0.0000]])
        >>> Status(tracks.status[1].item()).name
        'TOO_FEW_VIEWS'
    """
    check_tracks(proj, camera_index, point_index, weights, pixels=pixels, num_points=num_points)
    if values_at_hand(camera_index) and values_at_hand(point_index):
        check_range(camera_index, point_index, len(proj), num_points)
    weight = torch.ones_like(pixels[..., 0]) if weights is None else weights
    return operation(
        TriangulatedTracks,
        (proj, pixels, camera_index.long(), point_index.long(), weight),
        see=partial(pose_tracks, num_points=num_points),
        solve=solve_linear,
        follow=follow_linear,
        describe=_describe,
        dtype=proj.dtype,
        covariance=covariance,
        max_residual=max_residual,
        listed=True,
    )


def _describe(
    posed: PosedTracks, found: Solution, valid: Tensor, covariance: bool
) -> dict[str, Tensor]:
    (camera, px, py, weights, point, *_), count = posed, len(valid)
    place = torch.stack(kept(in_world(found.points, posed.datum), valid))
    both, each = at(valid, point), at(place, point)
    used = ~weights.unused & both
    x, y, depth = project_listed(camera, each)
    seen = projected(x, y, depth, used)
    squared = torch.where(seen.seen, weights.squared, 0.0)
    errors = squared_errors(seen, px, py)
    total = summed(squared, point, count)
    mean = safe_divide(summed(squared * errors, point, count), total, total > 0)
    fields = {
        "points": place.mT,
        "depth": torch.where(both, depth, 0.0),
        "residual": safe_sqrt(mean),
        "errors": safe_sqrt(errors),
        "parallax": _parallax(each - posed.center, used, point, count),
        "point_index": point,
        "used": ~weights.unused & at(weights.sound, point),
    }
    if covariance:
        # The derivative of a pixel by the point is its equations, divided by the depth.
        across, down = (
            seen.x * camera[2, :3] - camera[0, :3],
            seen.y * camera[2, :3] - camera[1, :3],
        )
        by_depth = squared * seen.inverse * seen.inverse
        information = summed_squares(across, down, by_depth, point, count)
        enough = summed(seen.seen.to(x.dtype), point, count) >= 2
        fields["covariance"] = unscaled(inverse_information(information, enough), weights.largest)
    return fields


@without_gradients
def _parallax(rays: Tensor, used: Tensor, point: Tensor, count: int) -> Tensor:
    """Angles ``(N)`` between the used of rays ``(3, T)``: of one far from their middle, to another.

    Of rays of unit length on a sphere, so that a chord stands for an angle. Who is farthest from
    the middle is at least half of the largest chord away from someone; who is farthest from that
    one, again and again, never comes nearer.
    """
    if len(point) == 0:
        return rays.new_zeros(count)
    tiny = torch.finfo(rays.dtype).tiny ** 0.5
    rays = rays * rays.square().sum(dim=0).clamp(min=tiny).rsqrt()
    number = torch.arange(len(point), device=point.device)
    counts = used.to(rays.dtype)
    middle = summed(rays * counts, point, count) / summed(counts, point, count).clamp(min=1)
    for _ in range(4):
        chord = torch.where(used, (rays - at(middle, point)).square().sum(dim=0), -1.0)
        largest = chord.new_zeros(count).scatter_reduce(0, point, chord, "amax")
        farthest = torch.where(used & (chord == at(largest, point)), number, 0)
        middle = at(rays, farthest.new_zeros(count).scatter_reduce(0, point, farthest, "amax"))
    return angle_of(largest)
