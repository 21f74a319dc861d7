"""Do maps of one scene agree, with those that see the same and with those before them?"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from deltas_geom import PosedViews, project, unproject
from deltas_nets.agree.neighbours import neighbours, sample
from deltas_nets.captures.frame import Frame
from deltas_nets.captures.work_size import camera_at

__all__ = [
    "AGREES",
    "SIZE",
    "Consistency",
    "SeenMaps",
    "agreeing_share",
    "flicker_of_pair",
    "same_places",
    "shrunk",
]

SIZE = (270, 360)
"""(height, width) at which maps are compared."""
AGREES = 0.05
"""By which share of it a depth may differ and agree."""
SAME = 0.02
"""The same of true depths that are of one place."""
NEIGHBOURS = 4
FEWEST = 500
"""Places that two successive frames must share."""
INDOORS = (0.5, 10.0)
"""(near, far) of the true depth that counts, metres, where none is given."""
Map = NDArray[np.float32]
Places = NDArray[np.intp]


class Consistency(NamedTuple):
    """Of the maps of a scene; None where no two of them see the same.

    Attributes:
        agreement: share of the pixels that a neighbouring map sees at the same depth, to 5 %: of a
            map's pixels that fall into the other's image, where that has a depth. What something
            nearer hides there counts as not agreeing, so the truth has no full share either.
        truth: the same of the sensor depth, over the same pairs.
        pairs: of maps and neighbours.
        flicker: between successive frames, by how much the log of the maps' errors differs at
            places that both see, as the true depth has it to 2 %; what the truth itself flickers is
            left out.
        successive: pairs of frames that share 500 places or more.
    """

    agreement: float | None
    truth: float | None
    pairs: int
    flicker: float | None
    successive: int


class SeenMaps:
    """Takes the maps of a scene in the order in which they were taken, made small.

    Args:
        depth_range: (near, far) of the true depth by which flicker is told, in the capture's unit.
    """

    def __init__(self, depth_range: tuple[float, float] = INDOORS) -> None:
        self._depth_range = depth_range
        self._views: list[PosedViews] = []
        self._maps: list[Map] = []
        self._truths: list[Map] = []

    def add(self, frame: Frame, depth: Map, truth: Map) -> None:
        """Take in a map.

        Args:
            frame: without a lens that bends lines; others are passed over.
            depth: ``(H, W)`` in the unit of the frame's pose.
            truth: ``(h, w)`` of the same image.
        """
        if frame.lens is not None:
            return
        self._views.append(camera_at(frame, SIZE))
        self._maps.append(shrunk(depth))
        self._truths.append(shrunk(truth))

    def result(self) -> Consistency:
        """What the maps so far say of each other."""
        near = self._neighbours() if len(self._maps) > 1 else []
        pairs = [(one, other) for one, others in enumerate(near) for other in others]
        ours, true = (
            [agreeing_share(self._views[a], maps[a], self._views[b], maps[b]) for a, b in pairs]
            for maps in (self._maps, self._truths)
        )
        flickers = [
            flicker_of_pair(
                (self._views[one], self._maps[one], self._truths[one]),
                (self._views[other], self._maps[other], self._truths[other]),
                depth_range=self._depth_range,
            )
            for one, other in pairwise(range(len(self._maps)))
        ]
        found = [value for value in flickers if value is not None]
        return Consistency(_mean(ours), _mean(true), len(pairs), _mean(found), len(found))

    def _neighbours(self) -> list[list[int]]:
        views = PosedViews(*(torch.cat(parts) for parts in zip(*self._views, strict=True)))
        maps = [torch.from_numpy(each)[None] for each in self._maps]
        points = torch.stack([sample(*each) for each in zip(maps, self._views, strict=True)])
        found = neighbours(points, views, [SIZE] * len(maps))
        return [places[:NEIGHBOURS] for places in found]


def agreeing_share(here: PosedViews, depth: Map, there: PosedViews, other: Map) -> float:
    """Share of the pixels that another map sees at the same depth; NaN if it sees none.

    Args:
        here: the camera of a map, ``(1)``, at its size.
        depth: ``(H, W)``.
        there: the camera of the other map.
        other: ``(h, w)``.
    """
    seen = _moved(here, depth, there, (other.shape[0], other.shape[1]), depth > 0)
    theirs = other.ravel()[seen.place]
    known = theirs > 0
    if not known.any():
        return float("nan")
    return float((np.abs(theirs[known] / seen.depth[known] - 1) < AGREES).mean())


def flicker_of_pair(
    first: tuple[PosedViews, Map, Map],
    second: tuple[PosedViews, Map, Map],
    *,
    depth_range: tuple[float, float] = INDOORS,
) -> float | None:
    """Mean difference of the log errors of two maps at the same places; None if these are few.

    Places where either map has no depth do not count, as no error is known there.

    Args:
        first: camera, map and true depth of a frame, of one size.
        second: of the next.
        depth_range: (near, far) of the true depth that counts.
    """
    here, there = same_places(first[0], first[2], second[0], second[2], depth_range=depth_range)
    known = (first[1].ravel()[here] > 0) & (second[1].ravel()[there] > 0)
    if known.sum() < FEWEST:
        return None
    one, other = (_log_error(depth, truth) for _, depth, truth in (first, second))
    return float(np.abs(one.ravel()[here] - other.ravel()[there])[known].mean())


def same_places(
    here: PosedViews,
    depth: Map,
    there: PosedViews,
    other: Map,
    *,
    depth_range: tuple[float, float] = INDOORS,
) -> tuple[Places, Places]:
    """Pixels of two frames, in their flat images, that show one place by the true depth of both.

    Args:
        here: camera of the first frame, ``(1)``.
        depth: ``(H, W)`` true depth, in the unit of the cameras.
        there: camera of the second frame.
        other: ``(h, w)`` its true depth.
        depth_range: (near, far) of the true depth that counts.
    """
    near, far = depth_range
    in_range = (depth > near) & (depth < far)
    seen = _moved(here, depth, there, (other.shape[0], other.shape[1]), in_range)
    true = other.ravel()[seen.place]
    same = (true > near) & (true < far) & (np.abs(true / seen.depth - 1) < SAME)
    return seen.pixel[same], seen.place[same]


def shrunk(image: Map, size: tuple[int, int] = SIZE) -> Map:
    """The pixel that holds each new centre."""
    rows = ((np.arange(size[0]) + 0.5) * image.shape[0] / size[0]).astype(int)
    columns = ((np.arange(size[1]) + 0.5) * image.shape[1] / size[1]).astype(int)
    small: Map = image[rows[:, None], columns]
    return small


class _Moved(NamedTuple):
    """Pixels of a map that fall into another image.

    Attributes:
        pixel: ``(N,)`` in the flat map.
        place: ``(N,)`` in the other flat image.
        depth: ``(N,)`` in the other camera.
    """

    pixel: Places
    place: Places
    depth: NDArray[np.float64]


def _moved(
    here: PosedViews, depth: Map, there: PosedViews, size: tuple[int, int], used: NDArray[np.bool_]
) -> _Moved:
    rows, columns = np.nonzero(used)
    pixels = torch.from_numpy(np.stack([columns, rows], axis=-1)).double()[None]
    z = torch.from_numpy(depth[rows, columns]).double()[None]
    seen = project(there, unproject(here, pixels, z)[0])
    column, row = (seen.pixels[0] + 0.5).floor().unbind(dim=-1)
    inside = seen.in_front[0] & (column >= 0) & (column < size[1]) & (row >= 0) & (row < size[0])
    place = (row * size[1] + column)[inside].long()
    kept = inside.numpy()
    pixel = (rows * depth.shape[1] + columns)[kept]
    return _Moved(pixel, place.numpy(), _array(seen.depth[0][inside]))


def _array(values: Tensor) -> NDArray[np.float64]:
    array: NDArray[np.float64] = values.numpy()
    return array


def _log_error(depth: Map, truth: Map) -> NDArray[np.float64]:
    """Log of the map by the truth; 0 where one is unknown."""
    both = (depth > 0) & (truth > 0)
    log: NDArray[np.float64] = np.log(
        np.where(both, depth.astype(np.float64) / np.where(both, truth, 1), 1)
    )
    return log


def _mean(values: Sequence[float]) -> float | None:
    finite = [value for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else None
