"""The folder that the depth command fills: safe to kill, continue, share and refuse.

Files in it are whole (`deltas_nets.outputs.atomic_files`), so a frame whose files all exist is
finished, whenever the run before was killed. Which files those are is a table in
`deltas_nets.outputs.products`. summary.json says what made them: it is written at the start (status
``running``) and at the end (``complete``, or ``stopped`` where frames are missing and no run is at
work); what it does not hold yet is in a journal (`deltas_nets.outputs.journal`). Several shards may
fill one folder; each keeps its own summary.I-of-N.json beside the summary of all, which names those
that it is ``waiting_for`` when none is running.
"""

import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from threading import Lock
from typing import Any

from deltas_nets.captures.ids import id_in_json
from deltas_nets.errors import UserError
from deltas_nets.outputs.atomic_files import (
    TEMPORARY,
    cannot_write,
    check_writable,
    plain,
    write_json,
)
from deltas_nets.outputs.beside import remove_beside
from deltas_nets.outputs.first_maps import FirstMaps
from deltas_nets.outputs.journal import Journal, read_journals, remove_journals
from deltas_nets.outputs.products import (
    PRODUCTS,
    FrameOutput,
    OutputOptions,
    products_of,
    remarks_on,
)
from deltas_nets.outputs.shards import write_shard_summary
from deltas_nets.outputs.summary import (
    SHARD_SUMMARY,
    SUMMARY,
    WRITER,
    difference,
    read_summary,
    shard_summary,
)

__all__ = ["OutputFolder", "prepare_output"]


class OutputFolder:
    """A folder being filled by one run; made by `prepare_output`."""

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


def prepare_output(
    out: str | Path,
    *,
    settings: Mapping[str, Any],
    overwrite: bool = False,
    forbidden: Path | None = None,
    shard: tuple[int, int] = (1, 1),
    frame_ids: Iterable[str] = (),
    options: OutputOptions = OutputOptions(),  # noqa: B008
    head: Mapping[str, Any] | None = None,
) -> OutputFolder:
    """Make or continue a folder for outputs, and write its summary with status ``running``.

    Args:
        out: the folder; its parents are made too.
        settings: what the results depend on (weights, views, sizes ...; not the device or
            the shard). A run continues another only where all of it is equal.
        overwrite: start again: remove the frames that earlier runs were to write and what shows
            them (`deltas_nets.outputs.beside`), and use a folder with other contents, in which only
            files of the same names are replaced.
        forbidden: the capture. Its own depth/ would be overwritten, so it is never an output.
        shard: which of how many runs that fill the folder this is, from 1.
        frame_ids: the frames of this run: what ``overwrite`` removes where others work too.
        options: what all frames have in common.
        head: goes to the summary beside the settings (versions, counts of lost frames).

    Returns:
        The folder; frames for which ``is_finished`` are to be kept.

    Raises:
        UserError: the folder cannot be written, holds something else, or was made with other
            settings. Nothing in it has been changed then.
    """
    out, frame_ids = Path(out), list(frame_ids)
    wanted = json.loads(json.dumps(plain(settings)))  # as it will be read back
    if forbidden is not None and out.resolve() == forbidden.resolve():
        what = "the output folder is the capture itself"
        raise UserError(what, out, "name another folder with --out")
    if any((out / name).is_dir() for name in ("color", "pose")):
        # Its depth/ may be what a sensor measured: not even --overwrite is meant for that.
        raise UserError("the output folder is a capture", out, "name another folder with --out")
    check_writable(out)
    # Listed before the summaries are read: what another shard has made by now has a summary.
    found = sorted(os.listdir(out)) if out.exists() else []
    others = [name for name in found if not TEMPORARY.match(name)]
    summaries = [SUMMARY, *filter(SHARD_SUMMARY.fullmatch, others)]
    earlier = [read for name in summaries if (read := read_summary(out / name)) is not None]
    if not overwrite:
        if others and not earlier:
            what = f"the output folder holds something else ({', '.join(others[:3])})"
            raise UserError(what, out, "name an empty folder, or add --overwrite")
        if earlier and earlier[0]["settings"] != wanted:
            what = f"an earlier run had other settings ({difference(earlier[0], wanted)})"
            raise UserError(what, out / SUMMARY, "name another folder, or add --overwrite")
    own = read_summary(out / SUMMARY if shard[1] == 1 else shard_summary(out, shard))
    frames = {} if own is None else dict(own["frames"])
    folder = OutputFolder(
        out,
        options=options,
        head={
            "writer": WRITER,
            "status": "running",
            **(head or {}),
            "files": [product.name for product in products_of(options)],
            "settings": wanted,
            "anchors": list(map(id_in_json, frame_ids)),
        },
        frames={} if overwrite else frames,
        shard=shard,
    )
    if not overwrite:
        folder.recover(None if shard[1] == 1 else frame_ids)
    try:
        # Before the new summary: killed in between, the old one still says what made the rest.
        out.mkdir(parents=True, exist_ok=True)
        if overwrite:
            old = {*frame_ids, *_not_planned(earlier, wanted, alone=shard[1] == 1)}
            remove_beside(out, old, earlier[0]["settings"] if earlier else None)
            _remove_frames(out, old)
            if shard[1] == 1:
                _remove_shard_summaries(out)
                FirstMaps.remove_all(out)
            folder.first.remove()
        if shard[1] == 1:
            _remove_temporary(out)
        folder.write_summary("running")
        if shard[1] == 1:
            remove_journals(out)
        for product in folder.products:
            (out / product.name).mkdir(exist_ok=True)
    except OSError as error:
        raise cannot_write(Path(error.filename or out), error) from error
    return folder


def _not_planned(
    earlier: Iterable[Mapping[str, Any]], wanted: Mapping[str, Any], *, alone: bool
) -> set[str]:
    """Frames that earlier runs were to write and no run of ours writes now.

    Args:
        earlier: summaries.
        wanted: the settings of now, which name the frames of all shards.
        alone: no other shard is at work.
    """
    planned = {str(id) for summary in earlier for id in summary.get("anchors", ())}
    if alone:
        return planned
    # Others may have written theirs by now.
    view_sets = wanted.get("view_sets")
    return planned - {str(anchor) for anchor, _ in view_sets} if view_sets else set()


def _remove_frames(out: Path, ids: Iterable[str]) -> None:
    """Remove the outputs of these frames; other files of the folder are not ours."""
    for id in ids:
        for product in PRODUCTS:
            product.file(out, id).unlink(missing_ok=True)


def _remove_shard_summaries(out: Path) -> None:
    for path in out.iterdir():
        if SHARD_SUMMARY.fullmatch(path.name):
            path.unlink()


def _remove_temporary(out: Path) -> None:
    """Remove what a killed run left half written; not beside other shards, which live."""
    files = [*out.glob("*"), *(file for row in PRODUCTS for file in (out / row.name).rglob("*"))]
    for path in files:
        if TEMPORARY.match(path.name):
            path.unlink(missing_ok=True)
