"""Depth searched where surfaces are: as the capture says, or as a first look does."""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from deltas_geom.checks import check_kind
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.centres import camera_centres
from deltas_nets.captures.frame import FloatArray, Frame
from deltas_nets.captures.known_depths import depths_of_sensor, points_in_view
from deltas_nets.captures.measured import Measured, MeasuredDepth
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.errors import UserError
from deltas_nets.predict.depth_map import DepthMap, PredictConfig, frames_of
from deltas_nets.predict.look import found_depths, look
from deltas_nets.predict.predictor import Predictor
from deltas_nets.predict.reach import ROOM, Reach, end_of_pile, reach_of, reach_within, wider

__all__ = ["Asked", "Completed", "Followed", "Found", "Search", "settled"]

FIRST_BASELINE = 0.2
"""Metres that the network takes the way between two views for, where nothing tells the unit."""
FIRST_RANGE = (0.2, 60.0)
"""Searched first then: 1 to 300 times that way."""
LOOKS = 4
"""At most; each but the last found that the search was too short."""


class Found(NamedTuple):
    """A map, and how it was searched for.

    Attributes:
        map: in the capture's unit.
        reach: of the last search.
        piled: the end of it, "near" or "far", at which points pile up all the same.
    """

    map: DepthMap
    reach: Reach
    piled: str | None


class Search(Protocol):
    """How a frame's depth is searched."""

    @property
    def measured(self) -> Callable[[ViewSet], MeasuredDepth | None]:
        """What is known of the anchor of a view set, in the capture's unit."""

    def __call__(self, predictor: Predictor, views: ViewSet, config: PredictConfig) -> Found:
        """The map of a view set; all but the range is the config's.

        Raises:
            UserError: an image cannot be read.
        """


class Asked:
    """A search in a range that the user states.

    Args:
        capture: the frames.
        depth_range: nearest and farthest depth, in the capture's unit.
        measured: depth that joins the triangulated points, if any.
    """

    def __init__(
        self,
        capture: Capture,
        depth_range: tuple[float, float],
        measured: Measured | None = None,
    ) -> None:
        self.measured = _Known(capture, measured)
        near, far = depth_range
        unit = 1.0 if capture.metric else (ROOM[0] * ROOM[1] / (near * far)) ** 0.5
        self.capture, self.reach = capture, Reach(near, far, unit)

    def __call__(self, predictor: Predictor, views: ViewSet, config: PredictConfig) -> Found:
        """See `Search`."""
        frames, known = frames_of(self.capture, views), self.measured(views)
        found = look(predictor, frames, config, self.reach, known)
        return Found(found, self.reach, end_of_pile(found_depths(found), self.reach))


class Followed:
    """A search that follows from the capture: its ranges, its sparse points, or a first look.

    Where points pile up at an end of that, sensor depth in metres tells more, or a wider look.

    Args:
        capture: the frames.
        measured: depth that joins the triangulated points, if any.
        as_rooms: whether surfaces of a capture in metres that says nothing else are expected to be
            as far as in rooms.
    """

    def __init__(
        self, capture: Capture, measured: Measured | None = None, *, as_rooms: bool = True
    ) -> None:
        self.measured = _Known(capture, measured)
        self.capture, self.as_rooms = capture, as_rooms and capture.metric

    def __call__(self, predictor: Predictor, views: ViewSet, config: PredictConfig) -> Found:
        """See `Search`."""
        frames = frames_of(self.capture, views)
        metric = self.capture.metric
        position, known = self.measured.position[views.anchor], self.measured(views)
        points, ranges = points_in_view(self.capture, position), self.capture.depth_ranges
        if ranges is not None:
            near, far = map(float, ranges[position])
            reach, sure = reach_within(near, far, metric=metric), True
        elif points is not None:
            reach, sure = reach_of(points[:, 2], metric=metric), True
        elif self.as_rooms:
            reach, sure = Reach(*ROOM), True
        else:
            reach, sure = _by_baseline(frames), False

        return settled(
            lambda reach: look(predictor, frames, config, reach, known),
            reach,
            sure=sure,
            metric=metric,
            sensor=lambda: depths_of_sensor(self.capture, position) if metric else None,
        )


def settled(
    looked: Callable[[Reach], DepthMap],
    reach: Reach,
    *,
    sure: bool,
    metric: bool,
    sensor: Callable[[], FloatArray | None] = lambda: None,
) -> Found:
    """Look until points do not pile up at an end of what is searched.

    Args:
        looked: the map of a search.
        reach: the first one.
        sure: whether that is kept if nothing piles up, or only tells where surfaces are.
        metric: whether the unit is the metre.
        sensor: depths in metres that tell more, if points pile up.
    """
    for _ in range(LOOKS - 1):
        found = looked(reach)
        depths = found_depths(found)
        piled = end_of_pile(depths, reach)
        if sure and piled is None:
            return Found(found, reach, None)
        # A sensor is asked only now, so that rooms do not depend on it.
        measured = sensor() if piled else None
        if measured is not None and reach_of(measured, metric=True) != reach:
            reach, sure = reach_of(measured, metric=True), True
        elif piled is not None:
            reach, sure = wider(reach, piled), False
        elif len(depths):
            reach, sure = reach_of(depths, metric=metric), True
        else:  # nothing tells where to look instead
            return Found(found, reach, None)
    found = looked(reach)
    return Found(found, reach, end_of_pile(found_depths(found), reach))


class Completed:
    """No search: maps of single frames and what was measured of them.

    Args:
        capture: the frames.
        measured: their depth.
    """

    def __init__(self, capture: Capture, measured: Measured) -> None:
        self.capture = capture
        self.measured = _Known(capture, measured)

    def __call__(self, predictor: Predictor, views: ViewSet, config: PredictConfig) -> Found:
        """See `Search`."""
        known = self.measured(views)
        if known is None or len(known.depth) == 0:
            what = f"nothing is measured of frame {views.anchor}"
            raise UserError(what, self.capture.path, "leave it out, or use --views 2 or more")
        reach = reach_of(known.depth, metric=self.capture.metric)
        found = look(predictor, [self.capture.frame(views.anchor)], config, reach, known)
        return Found(found, reach, None)


class _Known:
    """What is measured of an anchor."""

    def __init__(self, capture: Capture, measured: Measured | None) -> None:
        check_kind("capture", capture, Capture, "open_capture(PATH)")
        self.position = {id: position for position, id in enumerate(capture.frames)}
        self._measured = measured

    def __call__(self, views: ViewSet) -> MeasuredDepth | None:
        return None if self._measured is None else self._measured(self.position[views.anchor])


def _by_baseline(frames: Sequence[Frame]) -> Reach:
    """A wide search, of a world in which the cameras stand as usual."""
    centres = camera_centres(np.stack([frame.cam_from_world for frame in frames]))
    apart = float(np.median(np.linalg.norm(centres[1:] - centres[0], axis=-1)))
    unit = FIRST_BASELINE / apart if apart > 0 else 1.0
    return Reach(FIRST_RANGE[0] / unit, FIRST_RANGE[1] / unit, unit)
