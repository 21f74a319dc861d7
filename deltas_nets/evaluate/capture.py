"""A capture's depth maps against its sensor depth."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import Frame
from deltas_nets.captures.view_sets import ViewSet, check_frames
from deltas_nets.errors import UserError
from deltas_nets.evaluate.calibration import CalibrationMeter
from deltas_nets.evaluate.consistency import SeenMaps
from deltas_nets.evaluate.points import score_keypoints
from deltas_nets.evaluate.scores import CaptureScores, MapScores, mean_scores, score_map
from deltas_nets.evaluate.truth import Truth, TruthSize
from deltas_nets.outputs.depth_formats import read_depth_map
from deltas_nets.outputs.summary import SUMMARY, read_summary, recorded_depth_scale
from deltas_nets.outputs.their_capture import in_their_unit
from deltas_nets.predict.depth_map import KeypointDepths, PredictConfig, frames_of, resized
from deltas_nets.predict.look import look
from deltas_nets.predict.predictor import Predictor
from deltas_nets.predict.reach import Reach
from deltas_nets.terminal import counted

Map = NDArray[np.float32]


@dataclass(frozen=True)
class Scoring:
    """How maps are compared with the truth."""

    depth_range: tuple[float, float] = (0.5, 10.0)
    """(near, far) of the true depth that counts, metres."""
    truth_size: TruthSize = "map"
    """At which pixels; see `Truth`."""
    consistency: bool = False
    """Whether maps are compared with each other too."""


class _Scored(NamedTuple):
    """A map to be scored, and the points and the deviation that it comes with, if any."""

    depth: Map
    keypoints: KeypointDepths | None
    relative_std: Map | None


def evaluate_network(
    predictor: Predictor,
    capture: Capture,
    view_sets: Sequence[ViewSet],
    config: PredictConfig,
    scoring: Scoring | None = None,
    *,
    meter: CalibrationMeter | None = None,
    report: Callable[[str], None] = lambda _: None,
) -> CaptureScores:
    """Predict every view set and score it; what fails is counted, and the rest goes on.

    Args:
        predictor: of a trained network.
        capture: frames with sensor depth.
        view_sets: anchors and sources.
        config: as for prediction.
        scoring: how; by default at the map's size, over the range that is searched.
        meter: takes in all maps too, if given.
        report: called with the id of every finished frame.

    Raises:
        UserError: all frames fail, or no anchor has true depth in range.
    """

    def predicted(views: ViewSet) -> _Scored:
        return _predicted(predictor, capture, views, config)

    scoring = scoring or Scoring(config.depth_range)
    return _evaluate(predicted, capture, view_sets, scoring, meter, report)


def score_view_set(
    predictor: Predictor,
    capture: Capture,
    views: ViewSet,
    config: PredictConfig,
    scoring: Scoring,
    meter: CalibrationMeter,
) -> MapScores | None:
    """Predict one view set and score it; None where no true depth is in range.

    Args:
        predictor: of a trained network, or a baseline.
        capture: frames with sensor depth.
        views: anchor and sources.
        config: as for prediction.
        scoring: how.
        meter: takes in the map, if it states a deviation.

    Raises:
        UserError: an image or depth cannot be read, or the predictor refuses.
    """
    truth = Truth.of(capture.frame(views.anchor), scoring.truth_size)
    return _score(_predicted(predictor, capture, views, config), truth, scoring, meter)


def evaluate_files(
    predictions: Path,
    capture: Capture,
    view_sets: Sequence[ViewSet],
    *,
    scoring: Scoring | None = None,
    report: Callable[[str], None] = lambda _: None,
) -> CaptureScores:
    """Score the maps that `deltas depth` wrote, or another program in its layout.

    Args:
        predictions: its output folder, which holds depth/ID.png, npz, tiff or pfm.
        capture: frames with sensor depth.
        view_sets: whose anchors are scored.
        scoring: how; as `Scoring` has it if not given.
        report: called with the id of every finished frame.

    Raises:
        UserError: all frames fail, no anchor has true depth in range, or no map depth there.
    """
    scale = recorded_depth_scale(predictions)
    ours = read_summary(predictions / SUMMARY) is not None
    capture = in_their_unit(capture, predictions)

    def read(views: ViewSet) -> _Scored:
        depth = read_depth_map(predictions, views.anchor, scale, ours=ours)
        _check_upright(depth, capture.frame(views.anchor), predictions)
        return _Scored(depth, None, None)

    scores = _evaluate(read, capture, view_sets, scoring or Scoring(), None, report)
    if not any(each.sums.used for each in scores.maps.values()):
        what = "no map has depth where the true depth is, of " + counted(len(scores.maps), "map")
        again = "run deltas depth again, with a lower --min-confidence"
        remedy = again if ours else "write depth along z, where 0 and NaN are none"
        raise UserError(what, predictions / "depth", remedy)
    return scores


def _check_upright(depth: Map, frame: Frame, folder: Path) -> None:
    """Refuse a map that lies where its photo stands: it would be squeezed to the truth's shape."""
    (height, width), (rows, columns) = depth.shape, frame.image_size
    if (height - width) * (rows - columns) < 0:
        what = f"the map of frame {frame.id} is {width}x{height} and its photo {columns}x{rows}"
        raise UserError(f"{what}: it is turned", folder / "depth", "write maps as photos lie")


def _predicted(
    predictor: Predictor, capture: Capture, views: ViewSet, config: PredictConfig
) -> _Scored:
    found = look(predictor, frames_of(capture, views), config, Reach(*config.depth_range))
    size = (found.depth.shape[0], found.depth.shape[1])
    std = None if found.log_std is None else np.exp(resized(found.log_std, size))
    return _Scored(found.depth, found.keypoints, std)


def _evaluate(
    mapped: Callable[[ViewSet], _Scored],
    capture: Capture,
    view_sets: Sequence[ViewSet],
    scoring: Scoring,
    meter: CalibrationMeter | None,
    report: Callable[[str], None],
) -> CaptureScores:
    scores: dict[str, MapScores | None] = {}
    failed: dict[str, UserError] = {}
    own, seen = CalibrationMeter(), SeenMaps(scoring.depth_range)
    measured: list[float] = []
    for views in view_sets:
        try:
            check_frames(capture, [views], with_depth=True)
            frame = capture.frame(views.anchor)
            truth, found = Truth.of(frame, scoring.truth_size), mapped(views)
        except UserError as error:
            failed[views.anchor] = error
            report(views.anchor)
            continue
        known = truth.own[truth.own > 0]
        measured += [float(known.min()), float(known.max())] if known.size else []
        scores[views.anchor] = _score(found, truth, scoring, own)
        if scoring.consistency:
            seen.add(frame, found.depth, truth.at_image)
        report(views.anchor)
    if failed and not scores:
        raise next(iter(failed.values()))
    if all(score is None for score in scores.values()):
        raise _none_in_range(capture, scoring.depth_range, measured)
    if meter is not None:
        meter.take(own)
    return mean_scores(
        scores,
        None if own.empty else own.result(),
        failed={id: str(error) for id, error in failed.items()},
        consistency=seen.result() if scoring.consistency else None,
        metric=capture.metric,
    )


def _none_in_range(
    capture: Capture, depth_range: tuple[float, float], measured: Sequence[float]
) -> UserError:
    """What to say where nothing could be scored: nothing is measured, or in another range."""
    if not measured:
        what = "no anchor has true depth in range"
        return UserError(what, capture.path, "name a capture with sensor depth")
    near, far = depth_range
    found = f"{min(measured):.3g} to {max(measured):.3g}"
    what = f"all true depth ({found}) is outside {near:g} to {far:g}"
    unit = "in metres" if capture.metric else "in the capture's own unit"
    return UserError(what, capture.path, f"give --depth-range NEAR FAR {unit}")


def _score(
    found: _Scored, truth: Truth, scoring: Scoring, meter: CalibrationMeter
) -> MapScores | None:
    sparse = None
    if found.keypoints is not None:
        sparse = score_keypoints(found.keypoints, truth.at_image, scoring.depth_range)
    if found.relative_std is None:
        true, depth = truth.beside(found.depth)
        return score_map(depth, true, scoring.depth_range, sparse)
    true, depth, std = truth.beside(found.depth, found.relative_std)
    meter.add(depth, std, true, depth_range=scoring.depth_range)
    return score_map(depth, true, scoring.depth_range, sparse, std)
