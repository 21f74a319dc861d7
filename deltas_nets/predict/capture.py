"""A capture becomes a folder of depth maps."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.outputs.folder import OutputFolder
from deltas_nets.outputs.verdict import Verdict, verdict
from deltas_nets.predict.depth_map import PredictConfig
from deltas_nets.predict.passes import Passes, Progress
from deltas_nets.predict.predictor import Predictor
from deltas_nets.predict.search import Asked, Search

FEWEST = 3
"""Maps of which a second pass can make something."""


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
        folder: from :func:`deltas_nets.outputs.prepare.prepare_output`.
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
    run = Passes(predictor, capture, folder, config, search, threads=threads, progress=progress)
    seen = (*view_sets, *heard)
    agreeing = passes > 1 and predictor.states_confidence and len(seen) >= FEWEST
    kept = [views.anchor for views in view_sets if folder.is_finished(views.anchor)]
    for id in kept:
        folder.keep_frame(id)
    done = set(kept)
    missing = [views for views in view_sets if views.anchor not in done]
    outcome, began, status = Outcome(kept=len(kept)), time.perf_counter(), "stopped"
    try:
        twice = agreeing and missing
        for record in run.agreeing(missing, seen, passes) if twice else run.alone(missing):
            outcome = outcome.and_one(record)
        folder.remove_first()
        status = "complete"
    finally:
        said = verdict(list(folder.frames.values()), short=short)
        seconds = round(time.perf_counter() - began, 3)
        folder.write_summary(status, seconds=seconds, verdict=said.line)
    return outcome._replace(verdict=said) if outcome.written else outcome
