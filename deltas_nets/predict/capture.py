"""A capture becomes a folder of depth maps."""

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.ids import id_in_json
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.outputs.folder import OutputFolder
from deltas_nets.outputs.products import FrameOutput
from deltas_nets.outputs.verdict import Verdict, verdict
from deltas_nets.predict.depth_map import PredictConfig
from deltas_nets.predict.look import found_depths
from deltas_nets.predict.predictor import Predictor
from deltas_nets.predict.search import Asked, Found, Search

SECONDS_BETWEEN_SUMMARIES = 5.0


class Outcome(NamedTuple):
    """What became of the view sets.

    Attributes:
        written: maps.
        kept: maps from before.
        blind: maps without a single triangulated point.
        piled: maps whose points pile up at an end of what was searched.
        verdict: on all maps of the folder; None where none was written.
    """

    written: int = 0
    kept: int = 0
    blind: int = 0
    piled: int = 0
    verdict: Verdict | None = None

    def and_one(self, found: Found) -> "Outcome":
        """With one more map written."""
        return self._replace(
            written=self.written + 1,
            blind=self.blind + (len(found_depths(found.map)) == 0),
            piled=self.piled + (found.piled is not None),
        )


def predict_capture(
    predictor: Predictor,
    capture: Capture,
    view_sets: Sequence[ViewSet],
    folder: OutputFolder,
    config: PredictConfig,
    *,
    search: Search | None = None,
    short: int = 0,
    report: Callable[[str], None] = lambda _: None,
) -> Outcome:
    """Write depth, points and confidence, if any, of every view set that is not finished yet.

    Args:
        predictor: of a trained network.
        capture: the frames.
        view_sets: anchors and sources.
        folder: from :func:`deltas_nets.outputs.folder.prepare_output`.
        config: sizes, range, confidence.
        search: how depth is searched; in the config's range if not given.
        short: view sets with fewer views than asked, for the verdict.
        report: called with the id of every finished frame.

    Returns:
        How many maps were written and kept, and what they are like.

    Raises:
        UserError: a file cannot be read or written. What is finished by then stays, and is
            kept when the same is asked for again.
    """
    outcome = Outcome()
    search = search or Asked(capture, config.depth_range)
    began = recorded = time.perf_counter()
    status = "stopped"
    try:
        for views in view_sets:
            if folder.is_finished(views.anchor):
                folder.keep_frame(views.anchor)
                outcome = outcome._replace(kept=outcome.kept + 1)
            else:
                outcome = outcome.and_one(_write(predictor, capture, views, folder, config, search))
            if time.perf_counter() - recorded > SECONDS_BETWEEN_SUMMARIES:
                folder.write_summary("running")
                recorded = time.perf_counter()
            report(views.anchor)
        status = "complete"
    finally:
        said = verdict(list(folder.frames.values()), short=short)
        seconds = round(time.perf_counter() - began, 3)
        folder.write_summary(status, seconds=seconds, verdict=said.line)
    return outcome._replace(verdict=said) if outcome.written else outcome


def _write(
    predictor: Predictor,
    capture: Capture,
    views: ViewSet,
    folder: OutputFolder,
    config: PredictConfig,
    search: Search,
) -> Found:
    """Write one view set's outputs."""
    started = time.perf_counter()
    found = search(predictor, views, config)
    result, valid = found.map, len(found_depths(found.map))
    record: dict[str, Any] = {
        "status": "ok" if valid else "no point triangulated",
        "sources": list(map(id_in_json, views.sources)),
        "valid_points": valid,
        "keypoints": len(result.keypoints.depth),
        "depth_range": [found.reach.near, found.reach.far],
        "seconds": round(time.perf_counter() - started, 4),
    }
    if result.confidence is not None:
        record["confidence"] = round(float(result.confidence.mean()), 4)
    if found.piled is not None:
        record["points_pile_up"] = found.piled
    anchor = capture.frame(views.anchor)
    folder.write_frame(
        FrameOutput(anchor, result.depth, result.confidence, result.points, result.colors), record
    )
    return found
