"""The passes over a capture: what the network finds of each view set, and what maps hear then."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.ids import id_in_json
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.check.workers import side_by_side
from deltas_nets.outputs.first_maps import FirstMaps
from deltas_nets.outputs.folder import OutputFolder
from deltas_nets.outputs.products import FrameOutput
from deltas_nets.predict.depth_map import DepthMap, PredictConfig
from deltas_nets.predict.later_passes import LaterPasses
from deltas_nets.predict.look import found_depths
from deltas_nets.predict.predictor import Predictor
from deltas_nets.predict.search import Found, Search

__all__ = ["Passes", "Progress"]

SECONDS_BETWEEN_SUMMARIES = 5.0
SMALL = (96, 128)
"""(height, width) of maps that nobody sees."""

Progress = Callable[[str, int], AbstractContextManager[Callable[[str], None]]]
"""As `deltas_nets.terminal.progress`: a name and a total become a function to call for each."""
Record = dict[str, Any]
Made = TypeVar("Made")


class Passes:
    """Makes the maps of view sets and writes them, and the summary of a run that goes on.

    Args:
        predictor: of a trained network.
        capture: the frames.
        folder: to write to.
        config: sizes, range, confidence.
        search: how depth is searched.
        threads: maps computed at once, each by one thread.
        progress: gets the name and the number of each pass's maps.
    """

    def __init__(
        self,
        predictor: Predictor,
        capture: Capture,
        folder: OutputFolder,
        config: PredictConfig,
        search: Search,
        *,
        threads: int,
        progress: Progress,
    ) -> None:
        self.predictor, self.capture, self.folder = predictor, capture, folder
        self.config, self.search = config, search
        self.threads, self.progress = threads, progress
        self._summary_written = time.perf_counter()

    def alone(self, missing: Sequence[ViewSet]) -> Iterator[Record]:
        """The records of maps as the network finds them, each when it is written."""

        def make(views: ViewSet) -> Record:
            found, record = self._found(views, self.config)
            return self._written(views, found.map, record)

        return self._each("depth", missing, make)

    def agreeing(
        self, missing: Sequence[ViewSet], seen: Sequence[ViewSet], passes: int
    ) -> Iterator[Record]:
        """The records of maps that have heard each other, each when it is written.

        Args:
            missing: the maps that are wanted.
            seen: those that they hear, themselves among them, whether finished or not: what the
                others hear must not depend on when a run ended.
            passes: 2 or more.
        """
        first = self.folder.first
        self._all("depth", [views for views in seen if first.read(views.anchor) is None], self._see)
        ids = [views.anchor for views in seen]
        later = LaterPasses(self.capture, first, ids, self.predictor)
        told = first
        for number in range(2, passes):
            told = self._passed_on(later, told, number, seen)

        def make(views: ViewSet) -> Record:
            heard = later.hear(views.anchor, told)
            measured = self.search.measured(views)
            found, record = later.finished(views.anchor, heard, self.config, measured)
            record["network_confidence"] = record["confidence"]
            return self._written(views, found, record | _confidence(found.confidence))

        return self._each("agreement", missing, make)

    def _see(self, views: ViewSet) -> None:
        """Keep what the first pass finds."""
        found, record = self._found(views, replace(self.config, size=self.config.size or SMALL))
        assert found.map.work is not None  # the network states a deviation
        self.folder.first.write(views.anchor, found.map.work, record)

    def _passed_on(
        self, later: LaterPasses, told: FirstMaps, number: int, seen: Sequence[ViewSet]
    ) -> FirstMaps:
        """The maps of a pass between first and last, which heard those of the one before."""
        maps = later.first.of_pass(number)

        def pass_on(views: ViewSet) -> None:
            maps.write(views.anchor, later.hear(views.anchor, told), {})

        unheard = [views for views in seen if maps.read(views.anchor) is None]
        self._all("agreement", unheard, pass_on)
        return maps

    def _all(self, name: str, todo: Sequence[ViewSet], make: Callable[[ViewSet], object]) -> None:
        for _ in self._each(name, todo, make):
            pass

    def _each(
        self, name: str, todo: Sequence[ViewSet], make: Callable[[ViewSet], Made]
    ) -> Iterator[Made]:
        """What is made of each view set, with progress, and a summary every few seconds."""
        with self.progress(name, len(todo)) as report:
            made = side_by_side(make, todo, self.threads)
            for views, one in zip(todo, made, strict=True):
                yield one
                report(views.anchor)
                if time.perf_counter() - self._summary_written > SECONDS_BETWEEN_SUMMARIES:
                    self.folder.write_summary("running")
                    self._summary_written = time.perf_counter()

    def _found(self, views: ViewSet, config: PredictConfig) -> tuple[Found, Record]:
        """A view set's map and what the summary says of it."""
        started = time.perf_counter()
        found = self.search(self.predictor, views, config)
        result, valid = found.map, len(found_depths(found.map))
        record: Record = {
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
        if result.measured_factor is not None:
            record["measured_factor"] = float(f"{result.measured_factor:.4g}")
        return found, record

    def _written(self, views: ViewSet, found: DepthMap, record: Record) -> Record:
        """The record of a map whose files are there now."""
        anchor = self.capture.frame(views.anchor)
        output = FrameOutput(anchor, found.depth, found.confidence, found.points, found.colors)
        self.folder.write_frame(output, record)
        return record


def _confidence(confidence: NDArray[np.float32] | None) -> dict[str, float]:
    return {} if confidence is None else {"confidence": round(float(confidence.mean()), 4)}
