"""What a few maps tell of a whole capture: how far its surfaces are, how long its unit is."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.known_depths import points_in_view
from deltas_nets.captures.measured import measured_by_hand
from deltas_nets.captures.spread import spread
from deltas_nets.captures.straight import lens_of
from deltas_nets.captures.view_choice import choose_view_sets
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.captures.work_size import depth_at_image
from deltas_nets.captures.working_depth import guessed_depth, knows_its_scale, working_depths
from deltas_nets.check.workers import side_by_side
from deltas_nets.errors import UserError
from deltas_nets.fuse.depth_view import nearest
from deltas_nets.network.unit import AS_IN_ROOMS
from deltas_nets.predict.depth_map import PredictConfig
from deltas_nets.predict.look import found_depths
from deltas_nets.predict.passes import SMALL
from deltas_nets.predict.predictor import Predictor
from deltas_nets.predict.search import Followed
from deltas_nets.terminal import warn

__all__ = ["depth_seen", "depth_unlike_rooms", "scale_by_measurements", "scale_by_sensor"]

ANCHORS = 5
"""Frames that are looked at."""
ENOUGH_FOR_ROOMS = 2
"""Of these one is enough to take a capture in metres for a room."""
SURE = 0.3
"""Mean confidence; usual is 0.5."""
ROUNDS = 3
"""At most, until views chosen for a depth find that depth."""
AGREES = 1.4
NEARLY = 1.5
"""Metres that a unit of a metric capture may be: what phones measure drifts."""
ENOUGH = 50
"""Pixels where map and sensor are compared."""


def depth_seen(
    predictor: Predictor,
    capture: Capture,
    config: PredictConfig,
    *,
    threads: int = 1,
    report: Callable[[str], None] = lambda _: None,
) -> float:
    """How far typical surfaces are, in the capture's unit: as it knows, or as a first look finds.

    Args:
        predictor: of a trained network.
        capture: the frames.
        config: all but the range.
        threads: maps computed at once.
        report: called with the id of every frame that was looked at, ``ANCHORS`` at a time.

    Raises:
        UserError: an image cannot be read, or there are fewer than two frames.
    """
    if knows_its_scale(capture):
        return float(np.median(working_depths(capture)))
    depth = guessed_depth(capture)
    for _ in range(ROUNDS):
        anchors = spread(list(capture.frames), ANCHORS)
        looks = _looks(predictor, capture, config, depth, anchors, threads=threads, report=report)
        medians = [look.depth for look in looks if look.depth > 0]
        if not medians:
            break
        before, depth = depth, float(np.median(medians))
        if 1 / AGREES < depth / before < AGREES:
            break
    return depth


def depth_unlike_rooms(
    predictor: Predictor,
    capture: Capture,
    config: PredictConfig,
    *,
    threads: int = 1,
    report: Callable[[str], None] = lambda _: None,
) -> float | None:
    """How far typical surfaces are, where nothing states it and they are not as far as in rooms.

    A metre tells nothing of that: captures in metres are of a desk, a room or a street. Such a one
    is of a room unless a network that knows how sure it is sees otherwise in all it looks at.

    Args:
        predictor: of a trained network.
        capture: the frames.
        config: all but the range.
        threads: maps computed at once.
        report: called with the id of every frame that was looked at.

    Returns:
        In the capture's unit; None where that is stated, or as in rooms.

    Raises:
        UserError: an image cannot be read, or there are fewer than two frames.
    """
    if knows_its_scale(capture) or (capture.metric and not predictor.states_confidence):
        return None
    if capture.metric and not _surely_unlike(predictor, capture, config, report):
        return None
    depth = depth_seen(predictor, capture, config, threads=threads, report=report)
    return None if capture.metric and _as_in_rooms(depth) else depth


def _surely_unlike(
    predictor: Predictor, capture: Capture, config: PredictConfig, report: Callable[[str], None]
) -> bool:
    """Whether two looks, at views that suit what they find, both see no room, and surely."""
    depth = guessed_depth(capture)
    for _ in range(ROUNDS):
        looks = []
        for anchor in spread(list(capture.frames), ENOUGH_FOR_ROOMS):
            looks += _looks(predictor, capture, config, depth, [anchor], report=report)
            if looks[-1].depth == 0 or _as_in_rooms(looks[-1].depth):
                return False
        if all(look.sure >= SURE for look in looks):
            return True
        depth = float(np.median([look.depth for look in looks]))
    return False


def _as_in_rooms(depth: float) -> bool:
    return AS_IN_ROOMS[0] <= depth <= AS_IN_ROOMS[1]


class _Look(NamedTuple):
    """What a map tells.

    Attributes:
        depth: the median of its points, in the capture's unit; 0 if there are none.
        sure: its mean confidence; 0 if the network states none.
    """

    depth: float
    sure: float


def _looks(
    predictor: Predictor,
    capture: Capture,
    config: PredictConfig,
    depth: float,
    anchors: Sequence[str],
    *,
    threads: int = 1,
    report: Callable[[str], None] = lambda _: None,
) -> list[_Look]:
    """Maps of a few frames, with views for surfaces at a depth, whatever the unit."""
    search, config = Followed(replace(capture, metric=False)), replace(config, size=SMALL)

    def look(views: ViewSet) -> _Look:
        map = search(predictor, views, config).map
        depths = found_depths(map)
        report(views.anchor)
        return _Look(
            float(np.median(depths)) if len(depths) else 0.0,
            0.0 if map.confidence is None else float(map.confidence.mean()),
        )

    some = choose_view_sets(capture, 3, working_depth=depth, anchors=anchors)
    return list(side_by_side(look, some, threads))


def scale_by_sensor(predictor: Predictor, capture: Capture, config: PredictConfig) -> float:
    """Metres in a unit of the capture, by its sensor depth.

    It is compared with sparse points where frames see some, else with maps of a few frames.

    Args:
        predictor: of a trained network.
        capture: the frames.
        config: as for the maps that are written; here they are whole, and as large as the photos.

    Raises:
        UserError: no frame has sensor depth that can be compared.
    """
    with_sensor = [id for id, frame in capture.frames.items() if frame.depth_path is not None]
    ratios: list[float] = []
    position = {id: number for number, id in enumerate(capture.frames)}
    for id in spread(with_sensor, 4 * ANCHORS):
        ratios += _ratios_at_points(capture, position[id]).tolist()
    if len(ratios) < ENOUGH:
        search, config = Followed(capture), _whole(config)
        for views in _some(capture, spread(with_sensor, ANCHORS)):
            depth = search(predictor, views, config).map.depth
            measured = depth_at_image(capture.frame(views.anchor))
            both = (depth > 0) & (measured > 0)
            ratios += (measured[both] / depth[both])[:: 1 + int(both.sum()) // 1000].tolist()
    if len(ratios) < ENOUGH:
        what, remedy = "no sensor depth tells the scale", "give --scale METRES_PER_UNIT"
        raise UserError(what, capture.path, remedy)
    return _doubted(float(np.median(ratios)), capture, "its sensor depth")


def scale_by_measurements(
    predictor: Predictor, capture: Capture, config: PredictConfig, file: Path
) -> float:
    """Metres in a unit of the capture, by depths that a person measured.

    Args:
        predictor: of a trained network.
        capture: the frames.
        config: as for the maps that are written; here they are whole, and as large as the photos.
        file: lines ``ID X Y METRES``: a frame, a pixel, and how far along the view what it shows
            is from the camera.

    Raises:
        UserError: the file is malformed, or names a frame or pixel that there is not.
    """
    search, config, ratios = Followed(capture), _whole(config), []
    for id, rows in measured_by_hand(file, capture).items():
        (views,) = _some(capture, [id])
        depth = search(predictor, views, config).map.depth
        for x, y, metres in rows:
            found = float(depth[round(y), round(x)])
            if found == 0:
                what = f"no depth was found at pixel ({x:g}, {y:g}) of frame {id}"
                raise UserError(what, file, "measure nearer to the middle of the photo")
            ratios.append(metres / found)
    return _doubted(float(np.median(ratios)), capture, str(file))


def _doubted(unit: float, capture: Capture, source: str) -> float:
    """Metres in a unit of the capture, with a warning where it says that there is one."""
    if capture.metric and not 1 / NEARLY < unit < NEARLY:
        warn(
            f"the capture is in metres already, and a unit of it is {unit:.4g} m by {source}: "
            "is that in metres?"
        )
    return unit


def _whole(config: PredictConfig) -> PredictConfig:
    """For maps of the photo's own pixels, with a depth at all of them."""
    return replace(config, size=None, min_confidence=0.0)


def _ratios_at_points(capture: Capture, position: int) -> FloatArray:
    """Sensor depth of a frame by that of its sparse points, where both are known."""
    points, frame = points_in_view(capture, position), capture.frames.at(position)
    if points is None:
        return np.zeros(0)
    pixels, seen = lens_of(frame).project(torch.from_numpy(points))
    measured = nearest(torch.from_numpy(depth_at_image(frame)), pixels) * seen
    known = measured.numpy() > 0
    ratios: FloatArray = measured.numpy()[known] / points[known, 2]
    return ratios


def _some(capture: Capture, anchors: Sequence[str]) -> tuple[ViewSet, ...]:
    return choose_view_sets(capture, 3, anchors=anchors)
