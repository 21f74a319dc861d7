"""Maps made ready to be added up: read, compared with their neighbours, a frame ahead."""

from collections import OrderedDict
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from deltas_nets.fuse.agreement import agreeing
from deltas_nets.fuse.config import FuseConfig
from deltas_nets.fuse.depth_view import DepthView
from deltas_nets.fuse.left_out import LeftOut, left_out_of
from deltas_nets.fuse.neighbours import neighbours
from deltas_nets.fuse.sources import DepthSource

__all__ = ["Prepared", "PreparedViews"]

REMEMBERED = 24
"""Maps that are kept in memory besides the neighbours of one: frames share them."""


class Prepared(NamedTuple):
    """A map to be added up.

    Attributes:
        id: of its frame.
        view: what is confirmed of it.
        left_out: what is not used; None if it had no depth.
    """

    id: str
    view: DepthView
    left_out: LeftOut | None


class PreparedViews:
    """The maps of a source, each less the depth that its neighbours do not confirm.

    Args:
        source: the maps.
        config: how many neighbours, and how well they have to agree.
    """

    def __init__(self, source: DepthSource, config: FuseConfig) -> None:
        self._source, self._config = source, config
        self._known: OrderedDict[str, DepthView] = OrderedDict()
        place = {id: position for position, id in enumerate(source.capture.frames)}
        self._positions = np.array([place[id] for id in source.ids], dtype=np.intp)
        self._place = place

    def ahead(self, ids: Sequence[str]) -> Iterator[Prepared]:
        """The maps of some ids; while one is used, another thread prepares the next."""
        with ThreadPoolExecutor(1) as worker:
            ready = worker.submit(self._prepared, ids[0]) if ids else None
            for following in [*ids[1:], None][: len(ids)]:
                assert ready is not None
                prepared = ready.result()
                ready = None if following is None else worker.submit(self._prepared, following)
                yield prepared

    def view(self, id: str) -> DepthView:
        """The map of a frame, as far as it is confirmed.

        Raises:
            UserError: a file cannot be read.
        """
        view, config = self._read(id), self._config
        if config.neighbours == 0:
            return view
        frames = self._source.capture.frames
        candidates = self._positions[self._positions != self._place[id]]
        near = neighbours(view, frames, candidates, config.neighbours)
        others = [self._read(frames.id_at(position)) for position in near]
        return agreeing(view, others, least=config.least, deviations=config.deviations)

    def _prepared(self, id: str) -> Prepared:
        view = self.view(id)
        doubtful = self._source.doubtful.get(id, 0.0)
        return Prepared(id, view, left_out_of(doubtful, self._read(id), view))

    def _read(self, id: str) -> DepthView:
        if id not in self._known:
            self._known[id] = self._source.view(id)
        self._known.move_to_end(id)
        while len(self._known) > REMEMBERED + self._config.neighbours:
            self._known.popitem(last=False)
        return self._known[id]
