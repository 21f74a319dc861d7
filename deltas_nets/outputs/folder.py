"""The folder that the depth command fills: safe to kill, continue, share and refuse.

Files in it are whole (`deltas_nets.outputs.atomic_files`), so a frame whose files all exist is
finished, whenever the run before was killed. Where the network states no confidence there is no
folder confidence. summary.json says what made the files: written at the start (status
``running``) and at the end (``complete``); what it does not hold yet is in
`deltas_nets.outputs.frame_records`. Several shards may fill one folder; each keeps its own
summary.I-of-N.json beside the summary of all.
"""

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from deltas_nets.errors import UserError
from deltas_nets.outputs.atomic_files import (
    TEMPORARY,
    cannot_write,
    check_writable,
    plain,
    write_json,
)
from deltas_nets.outputs.frame_records import FrameRecords, read_records, remove_records
from deltas_nets.outputs.products import (
    write_confidence_png,
    write_depth_png,
    write_points_ply,
)
from deltas_nets.outputs.summary import (
    SHARD_SUMMARY,
    SUMMARY,
    WRITER,
    difference,
    read_summary,
    shard_summary,
)

__all__ = ["OutputFolder", "prepare_output"]

KINDS = {"depth": ".png", "confidence": ".png", "points": ".ply"}

FrameId = int | str


class OutputFolder:
    """A folder being filled by one run; made by `prepare_output`."""

    def __init__(
        self,
        path: Path,
        *,
        kinds: Sequence[str],
        head: dict[str, Any],
        frames: dict[str, Any],
        shard: tuple[int, int],
    ) -> None:
        self.path = path
        self.kinds = kinds
        self._head = head
        self._frames = frames  # records of this run and of those it continues, by id
        self._shard = shard
        own = path / SUMMARY if shard[1] == 1 else shard_summary(path, shard)
        self._records = FrameRecords(own)

    def file(self, kind: str, id: FrameId) -> Path:
        """Where a frame's ``depth``, ``confidence`` or ``points`` are written."""
        return _file(self.path, kind, id)

    def is_finished(self, id: FrameId) -> bool:
        """Whether all files of a frame exist, and therefore are complete."""
        return all(self.file(kind, id).exists() for kind in self.kinds)

    def write_frame(
        self,
        id: FrameId,
        *,
        depth: ArrayLike,
        probability: ArrayLike | None,
        points: ArrayLike,
        colors: ArrayLike,
        record: Mapping[str, Any],
    ) -> None:
        """Write a frame's files; ``record`` (status, times) goes to the summary.

        Args:
            id: of the frame.
            depth: ``(H, W)`` metres.
            probability: ``(H, W)`` in [0, 1]; None where the folder holds no confidence.
            points: ``(N, 3)`` metres.
            colors: ``(N, 3)`` uint8.
            record: goes to the summary.

        Raises:
            ValueError: a probability is missing, or there is one too many.
        """
        if (probability is not None) != ("confidence" in self.kinds):
            raise ValueError(f"the folder holds {', '.join(self.kinds)}")
        # First: a frame is finished with the last of its files, and then it has a record.
        self._records.add(id, record)
        write_points_ply(self.file("points", id), points, colors)
        if probability is not None:
            write_confidence_png(self.file("confidence", id), probability)
        write_depth_png(self.file("depth", id), depth)
        self._frames[str(id)] = dict(record)

    def keep_frame(self, id: FrameId) -> None:
        """Count a frame that an earlier run finished; its record is kept where it had one."""
        self._frames.setdefault(str(id), {"status": "kept"})

    def recover(self, ids: Iterable[FrameId] | None) -> None:
        """Take over what killed runs had recorded of frames they finished; of these, if not all."""
        wanted = None if ids is None else set(map(str, ids))
        for id, record in read_records(self.path).items():
            if self.is_finished(id) and (wanted is None or id in wanted):
                self._frames[id] = record

    def write_summary(self, status: str, **more: Any) -> None:
        """Write the summary: ``running`` at the start and in between, then how it ended.

        Args:
            status: ``running``, ``stopped`` or ``complete``.
            more: goes to the summary beside the settings (times, counts).
        """
        self._head = self._head | more
        content = self._head | {"status": status, "frames": self._frames}
        if self._shard[1] > 1:
            self._write_shard_summary(content)
        else:
            write_json(self.path / SUMMARY, content)
        self._records.remove()

    def _write_shard_summary(self, content: dict[str, Any]) -> None:
        write_json(shard_summary(self.path, self._shard), content)
        # Others may finish between our reading and our writing. Who writes last reads once
        # more, so the summary that stays has seen everything.
        parts = self._parts()
        while True:
            write_json(self.path / SUMMARY, self._merged(content, parts))
            seen, parts = parts, self._parts()
            if seen == parts:
                return

    def _parts(self) -> list[dict[str, Any]]:
        """Summaries of the shards that work with our settings."""
        count = self._shard[1]
        paths = [shard_summary(self.path, (index, count)) for index in range(1, count + 1)]
        parts = [part for path in paths if (part := read_summary(path)) is not None]
        return [part for part in parts if part["settings"] == self._head["settings"]]

    def _merged(self, own: dict[str, Any], parts: list[dict[str, Any]]) -> dict[str, Any]:
        earlier = read_summary(self.path / SUMMARY)
        frames: dict[str, Any] = {}
        if earlier is not None and earlier["settings"] == self._head["settings"]:
            frames |= earlier["frames"]
        for part in parts:
            frames |= part["frames"]
        statuses = [part["status"] for part in parts]
        if statuses == ["complete"] * self._shard[1]:
            status = "complete"
        else:
            stopped = "stopped" in statuses and "running" not in statuses
            status = "stopped" if stopped else "running"
        return own | {"status": status, "frames": frames}


def prepare_output(
    out: str | Path,
    *,
    settings: Mapping[str, Any],
    overwrite: bool = False,
    forbidden: Path | None = None,
    shard: tuple[int, int] = (1, 1),
    frame_ids: Iterable[FrameId] = (),
    confidence: bool = True,
    head: Mapping[str, Any] | None = None,
) -> OutputFolder:
    """Make or continue a folder for outputs, and write its summary with status ``running``.

    Args:
        out: the folder; its parents are made too.
        settings: what the results depend on (weights, views, sizes ...; not the device or
            the shard). A run continues another only where all of it is equal.
        overwrite: start again: remove the frames that earlier runs were to write, and use a folder
            with other contents, in which only files of the same names are replaced.
        forbidden: the capture. Its own depth/ would be overwritten, so it is never an output.
        shard: which of how many runs that fill the folder this is, from 1.
        frame_ids: the frames of this run: what ``overwrite`` removes where others work too.
        confidence: whether maps of it are written, too.
        head: goes to the summary beside the settings (versions, counts of lost frames).

    Returns:
        The folder; frames for which ``is_finished`` are to be kept.

    Raises:
        UserError: the folder cannot be written, holds something else, or was made with other
            settings. Nothing in it has been changed then.
    """
    out, frame_ids = Path(out), list(frame_ids)
    kinds = [kind for kind in KINDS if confidence or kind != "confidence"]
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
        kinds=kinds,
        head={
            "writer": WRITER,
            "status": "running",
            **(head or {}),
            "files": kinds,
            "settings": wanted,
            "anchors": frame_ids,
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
            planned = {id for summary in earlier for id in summary.get("anchors", ())}
            _remove_frames(out, {*frame_ids, *(planned if shard[1] == 1 else ())})
            if shard[1] == 1:
                _remove_shard_summaries(out)
        if shard[1] == 1:
            _remove_temporary(out)
        folder.write_summary("running")
        if shard[1] == 1:
            remove_records(out)
        for kind in kinds:
            (out / kind).mkdir(exist_ok=True)
    except OSError as error:
        raise cannot_write(Path(error.filename or out), error) from error
    return folder


def _file(out: Path, kind: str, id: FrameId) -> Path:
    return out / kind / f"{id}{KINDS[kind]}"


def _remove_frames(out: Path, ids: Iterable[FrameId]) -> None:
    """Remove the outputs of these frames; other files of the folder are not ours."""
    for id in ids:
        for kind in KINDS:
            _file(out, kind, id).unlink(missing_ok=True)


def _remove_shard_summaries(out: Path) -> None:
    for path in out.iterdir():
        if SHARD_SUMMARY.fullmatch(path.name):
            path.unlink()


def _remove_temporary(out: Path) -> None:
    """Remove what a killed run left half written; not beside other shards, which live."""
    for folder in (out, *(out / kind for kind in KINDS)):
        for path in folder.iterdir() if folder.is_dir() else ():
            if TEMPORARY.match(path.name):
                path.unlink()
