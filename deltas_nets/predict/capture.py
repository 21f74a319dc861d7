"""From a capture to a folder of depth maps."""

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.ids import id_in_json
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.network.deltas import Deltas
from deltas_nets.outputs.folder import OutputFolder
from deltas_nets.outputs.products import FrameOutput
from deltas_nets.predict.depth_map import PredictConfig, frames_of
from deltas_nets.predict.encoded_frames import EncodedFrames
from deltas_nets.predict.ours import predict_map, remembering
from deltas_nets.reference import ReferenceNetwork

SECONDS_BETWEEN_SUMMARIES = 5.0


class Counts(NamedTuple):
    """What became of the view sets: maps written, kept from before, and written blindly."""

    written: int
    kept: int
    blind: int


def predict_capture(
    network: Deltas | ReferenceNetwork,
    capture: Capture,
    view_sets: Sequence[ViewSet],
    folder: OutputFolder,
    config: PredictConfig,
    *,
    report: Callable[[str], None] = lambda _: None,
) -> Counts:
    """Write depth, points and confidence, if any, of every view set that is not finished yet.

    Args:
        network: trained.
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
    counts = Counts(0, 0, 0)
    seer = remembering(network)
    began = recorded = time.perf_counter()
    status = "stopped"
    try:
        for views in view_sets:
            if folder.is_finished(views.anchor):
                folder.keep_frame(views.anchor)
                counts = counts._replace(kept=counts.kept + 1)
            else:
                blind = _predict_into(seer, capture, views, folder, config)
                counts = Counts(counts.written + 1, counts.kept, counts.blind + blind)
            if time.perf_counter() - recorded > SECONDS_BETWEEN_SUMMARIES:
                folder.write_summary("running")
                recorded = time.perf_counter()
            report(views.anchor)
        status = "complete"
    finally:
        folder.write_summary(status, seconds=round(time.perf_counter() - began, 3))
    return counts


def _predict_into(
    network: EncodedFrames | ReferenceNetwork,
    capture: Capture,
    views: ViewSet,
    folder: OutputFolder,
    config: PredictConfig,
) -> bool:
    """Write one view set's outputs; whether nothing could be triangulated."""
    started = time.perf_counter()
    frames = frames_of(capture, views)
    result = predict_map(network, frames, config)
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
