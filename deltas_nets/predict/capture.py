"""A capture becomes a folder of depth maps."""

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.ids import id_in_json
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.outputs.folder import OutputFolder
from deltas_nets.outputs.products import FrameOutput
from deltas_nets.predict.depth_map import PredictConfig, frames_of
from deltas_nets.predict.predictor import Predictor

SECONDS_BETWEEN_SUMMARIES = 5.0


class Outcome(NamedTuple):
    """What became of the view sets: maps written, kept from before, and written blindly."""

    written: int
    kept: int
    blind: int


def predict_capture(
    predictor: Predictor,
    capture: Capture,
    view_sets: Sequence[ViewSet],
    folder: OutputFolder,
    config: PredictConfig,
    *,
    report: Callable[[str], None] = lambda _: None,
) -> Outcome:
    """Write depth, points and confidence, if any, of every view set that is not finished yet.

    Args:
        predictor: of a trained network.
        capture: the frames.
        view_sets: anchors and sources.
        folder: from :func:`deltas_nets.outputs.folder.prepare_output`.
        config: sizes, range, confidence.
        report: called with the id of every finished frame.

    Returns:
        How many maps were written, kept, and written without a single triangulated point.

    Raises:
        UserError: a file cannot be read or written. What is finished by then stays, and is
            kept when the same is asked for again.
    """
    outcome = Outcome(0, 0, 0)
    began = recorded = time.perf_counter()
    status = "stopped"
    try:
        for views in view_sets:
            if folder.is_finished(views.anchor):
                folder.keep_frame(views.anchor)
                outcome = outcome._replace(kept=outcome.kept + 1)
            else:
                blind = _predict_into(predictor, capture, views, folder, config)
                outcome = Outcome(outcome.written + 1, outcome.kept, outcome.blind + blind)
            if time.perf_counter() - recorded > SECONDS_BETWEEN_SUMMARIES:
                folder.write_summary("running")
                recorded = time.perf_counter()
            report(views.anchor)
        status = "complete"
    finally:
        folder.write_summary(status, seconds=round(time.perf_counter() - began, 3))
    return outcome


def _predict_into(
    predictor: Predictor,
    capture: Capture,
    views: ViewSet,
    folder: OutputFolder,
    config: PredictConfig,
) -> bool:
    """Write one view set's outputs; whether nothing could be triangulated."""
    started = time.perf_counter()
    frames = frames_of(capture, views)
    result = predictor.depth_map(frames, config)
    valid = int((result.keypoints.depth > 0).sum())
    folder.write_frame(
        FrameOutput(frames[0], result.depth, result.confidence, result.points, result.colors),
        record={
            "status": "ok" if valid else "no point triangulated",
            "sources": list(map(id_in_json, views.sources)),
            "valid_points": valid,
            "seconds": round(time.perf_counter() - started, 4),
        },
    )
    return valid == 0
