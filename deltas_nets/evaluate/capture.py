"""A capture's depth maps against its sensor depth."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.captures.work_size import depth_at_image
from deltas_nets.errors import UserError
from deltas_nets.evaluate.calibration import CalibrationMeter
from deltas_nets.evaluate.points import score_keypoints
from deltas_nets.evaluate.scores import CaptureScores as CaptureScores
from deltas_nets.evaluate.scores import MapScores, mean_scores, score_map
from deltas_nets.evaluate.scores import resize_nearest as resize_nearest
from deltas_nets.outputs.depth_formats import read_depth_map
from deltas_nets.outputs.summary import recorded_depth_scale
from deltas_nets.predict.depth_map import PredictConfig, frames_of, resized
from deltas_nets.predict.look import look
from deltas_nets.predict.predictor import Predictor
from deltas_nets.predict.reach import Reach


def evaluate_network(
    predictor: Predictor,
    capture: Capture,
    view_sets: Sequence[ViewSet],
    config: PredictConfig,
    *,
    report: Callable[[str], None] = lambda _: None,
) -> CaptureScores:
    """Predict every view set and score it.

    Args:
        predictor: of a trained network.
        capture: frames with sensor depth.
        view_sets: anchors and sources.
        config: as for prediction.
        report: called with the id of every finished frame.

    Raises:
        UserError: an anchor has no sensor depth, or none of it is in range.
    """
    scores: dict[str, MapScores | None] = {}
    meter = CalibrationMeter()
    for views in view_sets:
        anchor = capture.frame(views.anchor)
        truth = depth_at_image(anchor)
        found = look(predictor, frames_of(capture, views), config, Reach(*config.depth_range))
        sparse = score_keypoints(found.keypoints, truth, config.depth_range)
        scores[str(views.anchor)] = score_map(found.depth, truth, config.depth_range, sparse)
        if found.log_std is not None:
            size = (found.depth.shape[0], found.depth.shape[1])
            relative_std = np.exp(resized(found.log_std, size))
            true = resize_nearest(truth, size)
            meter.add(found.depth, relative_std, true, depth_range=config.depth_range)
        report(str(views.anchor))
    return _mean(scores, capture.path, meter)


def evaluate_files(
    predictions: Path,
    capture: Capture,
    view_sets: Sequence[ViewSet],
    *,
    depth_range: tuple[float, float],
) -> CaptureScores:
    """Score the maps that `deltas depth` wrote.

    Args:
        predictions: its output folder.
        capture: frames with sensor depth.
        view_sets: whose anchors are scored.
        depth_range: (near, far) of the true depth that counts, metres.

    Raises:
        UserError: a map is missing or cannot be read.
    """
    scores: dict[str, MapScores | None] = {}
    scale = recorded_depth_scale(predictions)
    for views in view_sets:
        predicted = read_depth_map(predictions, views.anchor, scale)
        truth = depth_at_image(capture.frame(views.anchor))
        scores[str(views.anchor)] = score_map(predicted, truth, depth_range, None)
    return _mean(scores, capture.path, CalibrationMeter())


def _mean(
    scores: dict[str, MapScores | None], path: Path, meter: CalibrationMeter
) -> CaptureScores:
    if all(score is None for score in scores.values()):
        raise UserError(
            "no anchor has true depth in range", path, "name a capture with sensor depth"
        )
    return mean_scores(scores, None if meter.empty else meter.result())
