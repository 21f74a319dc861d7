"""A capture becomes a folder of depth maps."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.ids import id_in_json
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.check.workers import side_by_side
from deltas_nets.outputs.first_maps import FirstMaps
from deltas_nets.outputs.folder import OutputFolder
from deltas_nets.outputs.products import FrameOutput
from deltas_nets.outputs.verdict import Verdict, verdict
from deltas_nets.predict.depth_map import DepthMap, PredictConfig
from deltas_nets.predict.later_passes import LaterPasses
from deltas_nets.predict.look import found_depths
from deltas_nets.predict.predictor import Predictor
from deltas_nets.predict.search import Asked, Found, Search

SECONDS_BETWEEN_SUMMARIES = 5.0
FEWEST = 3
"""Maps of which a second pass can make something."""
SMALL = (96, 128)
"""(height, width) of maps that nobody sees."""

Progress = Callable[[str, int], AbstractContextManager[Callable[[str], None]]]
"""As `deltas_nets.terminal.progress`: a name and a total become a function to call for each."""


@contextmanager
def silent(name: str, total: int) -> Iterator[Callable[[str], None]]:
    """Progress that nobody sees."""
    yield lambda _: None


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

    def and_one(self, record: dict[str, Any]) -> "Outcome":
        """With one more map written."""
        return self._replace(
            written=self.written + 1,
            blind=self.blind + (record["valid_points"] == 0),
            piled=self.piled + ("points_pile_up" in record),
        )


def predict_capture(
    predictor: Predictor,
    capture: Capture,
    view_sets: Sequence[ViewSet],
    folder: OutputFolder,
    config: PredictConfig,
    *,
    heard: Sequence[ViewSet] = (),
    search: Search | None = None,
    short: int = 0,
    passes: int = 1,
    threads: int = 1,
    progress: Progress = silent,
) -> Outcome:
    """Write depth, points and confidence, if any, of every view set that is not finished yet.

    Args:
        predictor: of a trained network.
        capture: the frames.
        view_sets: anchors and sources.
        folder: from :func:`deltas_nets.outputs.folder.prepare_output`.
        config: sizes, range, confidence.
        heard: view sets whose maps the others hear in later passes, and nobody sees.
        search: how depth is searched; in the config's range if not given.
        short: view sets with fewer views than asked, for the verdict.
        passes: with 2 or more each map hears those of the frames around it, in every pass as
            they were after the one before; networks that state no deviation have one.
        threads: maps computed at once, each by one thread; with 1 torch's threads share a map.
        progress: gets the name and the number of each pass's maps.

    Returns:
        How many maps were written and kept, and what they are like.

    Raises:
        UserError: a file cannot be read or written. What is finished by then stays, and is
            kept when the same is asked for again.
    """
    search = search or Asked(capture, config.depth_range)
    first = folder.first
    seen = (*view_sets, *heard)
    twice = passes > 1 and predictor.states_confidence and len(seen) >= FEWEST
    kept = [views.anchor for views in view_sets if folder.is_finished(views.anchor)]
    for id in kept:
        folder.keep_frame(id)
    done = set(kept)
    missing = [views for views in view_sets if views.anchor not in done]
    outcome, began, status = Outcome(kept=len(kept)), time.perf_counter(), "stopped"
    summaries = _Summaries(folder)
    try:
        if twice and missing:
            # Of the finished ones too: what the others hear must not depend on when a run ended.
            unseen = [views for views in seen if first.read(views.anchor) is None]
            with progress("depth", len(unseen)) as report:

                def see(views: ViewSet) -> str:
                    found, record = _found(
                        predictor, views, replace(config, size=config.size or SMALL), search
                    )
                    assert found.map.work is not None  # it states a deviation
                    first.write(views.anchor, found.map.work, record)
                    return views.anchor

                for id in side_by_side(see, unseen, threads):
                    report(id)
                    summaries.now_and_then()
            later = LaterPasses(capture, first, [views.anchor for views in seen])
            told = first
            for number in range(2, passes):
                told = _passed_on(later, told, number, seen, threads, progress, summaries)

            def make(views: ViewSet) -> tuple[str, dict[str, Any]]:
                found, record = later.finished(views.anchor, later.hear(views.anchor, told), config)
                record["network_confidence"] = record["confidence"]
                record |= _confidence(found.confidence)
                _write(capture, views, folder, found, record)
                return views.anchor, record
        else:

            def make(views: ViewSet) -> tuple[str, dict[str, Any]]:
                found, record = _found(predictor, views, config, search)
                _write(capture, views, folder, found.map, record)
                return views.anchor, record

        with progress("agreement" if twice else "depth", len(missing)) as report:
            for id, record in side_by_side(make, missing, threads):
                outcome = outcome.and_one(record)
                report(id)
                summaries.now_and_then()
        first.remove()
        status = "complete"
    finally:
        said = verdict(list(folder.frames.values()), short=short)
        seconds = round(time.perf_counter() - began, 3)
        folder.write_summary(status, seconds=seconds, verdict=said.line)
    return outcome._replace(verdict=said) if outcome.written else outcome


def _passed_on(
    later: LaterPasses,
    told: FirstMaps,
    number: int,
    seen: Sequence[ViewSet],
    threads: int,
    progress: Progress,
    summaries: "_Summaries",
) -> FirstMaps:
    """The maps of a pass between the first and the last, which heard those of the one before."""
    maps = later.first.of_pass(number)

    def pass_on(views: ViewSet) -> str:
        maps.write(views.anchor, later.hear(views.anchor, told), {})
        return views.anchor

    unheard = [views for views in seen if maps.read(views.anchor) is None]
    with progress("agreement", len(unheard)) as report:
        for id in side_by_side(pass_on, unheard, threads):
            report(id)
            summaries.now_and_then()
    return maps


class _Summaries:
    """Writes the summary of a run that goes on, every few seconds."""

    def __init__(self, folder: OutputFolder) -> None:
        self.folder = folder
        self.written = time.perf_counter()

    def now_and_then(self) -> None:
        if time.perf_counter() - self.written > SECONDS_BETWEEN_SUMMARIES:
            self.folder.write_summary("running")
            self.written = time.perf_counter()


def _found(
    predictor: Predictor, views: ViewSet, config: PredictConfig, search: Search
) -> tuple[Found, dict[str, Any]]:
    """A view set's map and what the summary says of it."""
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
    } | _confidence(result.confidence)
    if not views.sources:
        del record["keypoints"]  # nothing was triangulated: what is measured was completed
    if found.piled is not None:
        record["points_pile_up"] = found.piled
    return found, record


def _confidence(confidence: NDArray[np.float32] | None) -> dict[str, float]:
    return {} if confidence is None else {"confidence": round(float(confidence.mean()), 4)}


def _write(
    capture: Capture,
    views: ViewSet,
    folder: OutputFolder,
    found: DepthMap,
    record: dict[str, Any],
) -> None:
    anchor = capture.frame(views.anchor)
    output = FrameOutput(anchor, found.depth, found.confidence, found.points, found.colors)
    folder.write_frame(output, record)
