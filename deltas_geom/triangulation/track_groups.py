"""Tracks as points with cameras of their own: groups of about as many observations each.

What is known of points that all views see is so known of tracks, at most half of a group's views
being padding. The groups depend on the values of indices, which therefore have to be at hand.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.checks import ShapeError, check_counts, check_given

_OBSERVATIONS = 2**14  # at a time, padding included: what lies between stays in the cache
_DIMS = {
    "proj": "C 3 4",
    "pixels": "T 2",
    "points": "N 3",
    "camera_index": "T",
    "point_index": "T",
    "weights": "T",
    "pose_covariance": "C 6 6",
}


class Group(NamedTuple):
    """Points of tracks that are about as long: M of them, padded to V views.

    Attributes:
        points: ``(M)`` their indices.
        places: ``(M, V)`` indices of their observations, those of a camera with a smaller index
            first; any in place of padding.
        real: ``(M, V)`` bool, False where it is padding.
    """

    points: Tensor
    places: Tensor
    real: Tensor


def check_tracks(
    proj: Tensor,
    camera_index: Tensor,
    point_index: Tensor,
    weights: Tensor | None,
    *,
    num_points: int = 0,
    **others: Tensor | None,
) -> None:
    """Raise unless lists of observations, of cameras and of points fit each other.

    Where indices lead is not looked at.
    """
    indices = {"camera_index": camera_index, "point_index": point_index}
    named = {"proj": proj, **others, **indices, "weights": weights}
    lists = check_given(**{name: (x, _DIMS[name]) for name, x in named.items()})
    # A list has no batch: cameras and points of all scenes may share one list instead.
    for name, (tensor, dims) in lists.items():
        if tensor.dim() != len(dims.split()):
            wanted = f"({', '.join(dims.split())})"
            raise ShapeError(f"{name} must have shape {wanted}, got {tuple(tensor.shape)}")
    check_counts(0, num_points=num_points)


def check_range(
    camera_index: Tensor, point_index: Tensor, num_cameras: int, num_points: int
) -> None:
    """Raise ``IndexError`` unless indices are of cameras and points; looks at values."""
    ends = (("camera_index", camera_index, num_cameras), ("point_index", point_index, num_points))
    for name, index, count in ends:
        if len(index) and not 0 <= int(index.min()) <= int(index.max()) < count:
            known = index.long()
            place = int(((known < 0) | (known >= count)).nonzero()[0])
            cure = ": leave out COLMAP's -1" if known[place] == -1 else ""
            raise IndexError(
                f"{name} must be from 0 to {count - 1}, got {int(known[place])} of observation "
                f"{place}{cure}"
            )


class Groups(NamedTuple):
    """All points once, and where to find them again.

    Attributes:
        groups: so many points each as keep what lies between small.
        point_at: ``(N)`` where each point is among those of all groups.
        seen_at: ``(T)`` where each observation is among those of all groups, padding included.
    """

    groups: tuple[Group, ...]
    point_at: Tensor
    seen_at: Tensor

    def points(self, parts: Sequence[Tensor]) -> Tensor:
        """``(N, ...)`` from what is known of each group's points, ``(M, ...)``."""
        return torch.cat(list(parts)).index_select(0, self.point_at)

    def observations(self, parts: Sequence[Tensor]) -> Tensor:
        """``(T)`` from what is known of each group's observations, ``(M, V)``."""
        return torch.cat([part.flatten() for part in parts]).index_select(0, self.seen_at)


def grouped(camera_index: Tensor, point_index: Tensor, num_cameras: int, num_points: int) -> Groups:
    """Points of up to 1, 2, 4, 8 and so on observations are a group, at 1 also those of none."""
    check_range(camera_index, point_index, num_cameras, num_points)
    point_index = point_index.long()
    # By point, then by camera, so that the order in the list does not count.
    order = (point_index * num_cameras + camera_index).argsort(stable=True)
    counts = torch.bincount(point_index, minlength=num_points)
    groups = tuple(_groups(order, counts))
    point_at, seen_at = torch.empty_like(counts), torch.empty_like(order)
    points = torch.cat([group.points for group in groups])
    point_at[points] = torch.arange(len(points), device=points.device)
    places = torch.cat([group.places.flatten() for group in groups])
    real = torch.cat([group.real.flatten() for group in groups])
    seen_at[places[real]] = real.nonzero().squeeze(-1)
    return Groups(groups, point_at, seen_at)


def _groups(order: Tensor, counts: Tensor) -> Iterator[Group]:
    first = counts.cumsum(dim=0) - counts
    longest = int(counts.max()) if len(counts) else 0
    # Of no observations at all there is one, of weight 0: see seen_by.
    order = order if len(order) else order.new_zeros(1)
    shorter, views = -1, 1
    while shorter < longest:
        points = ((counts > shorter) & (counts <= views)).nonzero().squeeze(-1)
        every = torch.split(points, max(1, _OBSERVATIONS // views))
        for some in every if len(points) or not len(counts) else ():
            real = torch.arange(views, device=some.device) < counts[some, None]
            # Padding is what one camera of the point has seen again, so that it stands nowhere
            # else; of a point without observations it is any.
            place = first[some, None] + (real.cumsum(dim=-1) - 1).clamp(min=0)
            yield Group(some, order[place.clamp(max=len(order) - 1)], real)
        shorter, views = views, 2 * views


def seen_by(
    group: Group, proj: Tensor, camera_index: Tensor, weights: Tensor, *more: Tensor
) -> tuple[Tensor, ...]:
    """A group's cameras ``(M, V, 3, 4)``, its weights ``(M, V, 1)``, 0 for padding, and the same
    ``(M, V, 1, ...)`` of ``more`` ``(T, ...)``: each point is a batch item with cameras of its own.
    """
    if len(camera_index) == 0:
        proj, camera_index = proj.new_zeros(1, 3, 4), camera_index.new_zeros(1)
        weights, more = weights.new_zeros(1), tuple(x.new_zeros(1, *x.shape[1:]) for x in more)
    views = rows_at(camera_index, group.places)
    weight = torch.where(group.real, rows_at(weights, group.places), 0.0)
    others = (rows_at(each, group.places).unsqueeze(2) for each in more)
    return rows_at(proj, views), weight.unsqueeze(-1), *others


def rows_at(values: Tensor, index: Tensor) -> Tensor:
    """Rows of values, by an index of any shape."""
    return values.index_select(0, index.flatten().long()).reshape(*index.shape, *values.shape[1:])
