"""The folder that the depth command fills: safe to kill, continue, share and refuse.

Files in it are whole (`deltas_nets.outputs.atomic_files`), so a frame whose files all exist is
finished, whenever the run before was killed. Which files those are is a table in
`deltas_nets.outputs.products`. summary.json says what made them: it is written at the start (status
``running``) and at the end (``complete``, or ``stopped`` where frames are missing and no run is at
work); what it does not hold yet is in a journal (`deltas_nets.outputs.journal`). Several shards may
fill one folder; each keeps its own summary.I-of-N.json beside the summary of all, which names those
that it is ``waiting_for``.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from threading import Lock
from typing import Any

from deltas_nets.outputs.atomic_files import write_json
from deltas_nets.outputs.first_maps import FirstMaps
from deltas_nets.outputs.journal import Journal, read_journals
from deltas_nets.outputs.products import FrameOutput, OutputOptions, products_of, remarks_on
from deltas_nets.outputs.shards import write_shard_summary
from deltas_nets.outputs.summary import SUMMARY, shard_summary

__all__ = ["OutputFolder"]


class OutputFolder:
    """A folder being filled by one run; made by `deltas_nets.outputs.prepare`."""

    def __init__(
        self,
        path: Path,
        *,
        options: OutputOptions,
        head: dict[str, Any],
        frames: dict[str, Any],
        shard: tuple[int, int],
    ) -> None:
        self.path = path
        self.products = products_of(options)
        self.frames = frames
        """Records of this run and of those it continues, by id."""
        self._options = options
        self._head = head
        self._shard = shard
        own = path / SUMMARY if shard[1] == 1 else shard_summary(path, shard)
        self._journal = Journal(own)
        self.first = FirstMaps(path, shard)
        """Maps of the first pass, while there are two."""
        self._begun: dict[str, Any] = {}
        self._lock = Lock()

    def file(self, product: str, id: str) -> Path:
        """Where a product of a frame is written."""
        return next(row for row in self.products if row.name == product).file(self.path, id)

    def is_finished(self, id: str) -> bool:
        """Whether all files of a frame exist, and therefore are complete."""
        return all(product.file(self.path, id).exists() for product in self.products)

    def write_frame(self, frame: FrameOutput, record: Mapping[str, Any]) -> None:
        """Write a frame's files; several threads may, each another's.

        Args:
            frame: what is known of it; with a confidence where the folder's options say so.
            record: status and times, for the summary.

        Raises:
            ValueError: a confidence is missing, or there is one too many.
        """
        if (frame.confidence is not None) != self._options.confidence:
            raise ValueError(f"the folder's options are {self._options}")
        id, record = frame.anchor.id, {**record, **remarks_on(frame, self._options)}
        # First: a frame is finished with the last of its files, and then it has a record.
        with self._lock:
            self._begun[id] = record
            self._journal.add(id, record)
        for product in reversed(self.products):
            product.write(product.file(self.path, id), frame, self._options)
        with self._lock:
            self.frames[id] = self._begun.pop(id)

    def keep_frame(self, id: str) -> None:
        """Count a frame that an earlier run finished; its record is kept where it had one."""
        self.frames.setdefault(id, {"status": "kept"})

    def recover(self, ids: Iterable[str] | None) -> None:
        """Take over what killed runs had recorded of the frames that they finished.

        Args:
            ids: the frames that count; None for all.
        """
        wanted = None if ids is None else set(ids)
        for id, record in read_journals(self.path).items():
            if self.is_finished(id) and (wanted is None or id in wanted):
                self.frames[id] = record

    def remove_first(self) -> None:
        """Remove the maps of the first pass, of all runs where no other is at work."""
        if self._shard[1] == 1:
            FirstMaps.remove_all(self.path)
        else:
            self.first.remove()

    def write_summary(self, status: str, **more: Any) -> None:
        """Write the summary: ``running`` at the start and in between, then how it ended.

        Args:
            status: of this run: ``running``, ``stopped`` or ``complete``.
            more: goes to the summary beside the settings (times, counts).
        """
        with self._lock:
            self._head = self._head | more
            # In the order that was planned, whichever thread was faster.
            place = {str(id): number for number, id in enumerate(self._head["anchors"])}
            frames = sorted(self.frames.items(), key=lambda item: place.get(item[0], len(place)))
            content = self._head | {"status": status, "frames": dict(frames)}
            if self._shard[1] > 1:
                write_shard_summary(self.path, self._shard, content)
            else:
                write_json(self.path / SUMMARY, content)
            self._journal.remove()
            for id, record in self._begun.items():
                self._journal.add(id, record)
