"""The folder that a run fills, refused or continued or emptied before anything is written."""

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from deltas_nets.captures.ids import id_in_json
from deltas_nets.errors import UserError
from deltas_nets.outputs.alone import LOCK
from deltas_nets.outputs.atomic_files import (
    TEMPORARY,
    cannot_write,
    check_writable,
    plain,
    remove_temporary,
    write_json,
)
from deltas_nets.outputs.beside import remove_beside
from deltas_nets.outputs.folder import OutputFolder
from deltas_nets.outputs.journal import remove_journals
from deltas_nets.outputs.products import PRODUCTS, OutputOptions, products_of
from deltas_nets.outputs.summary import (
    SHARD_SUMMARY,
    SUMMARY,
    WRITER,
    difference,
    read_summary,
    shard_summary,
)

__all__ = ["check_continues", "check_place", "prepare_output"]


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
    check_place(out, overwrite=overwrite, forbidden=forbidden)
    earlier = _earlier(out, wanted, (head or {}).get("scaled_by"), overwrite=overwrite)
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
        frames={} if overwrite else _recorded(out, shard, frame_ids),
        shard=shard,
    )
    alone = shard[1] == 1
    if not overwrite:
        folder.recover(None if alone else frame_ids)
    try:
        # Before the new summary: killed in between, the old one still says what made the rest.
        out.mkdir(parents=True, exist_ok=True)
        if overwrite:
            _mark_stopped(out, shard)
            planned = _not_planned(earlier, wanted, alone=alone)
            _remove_earlier(folder, {*frame_ids, *planned}, earlier, alone=alone)
        if alone:  # else other shards may be writing
            inside = (file for row in PRODUCTS for file in (out / row.name).rglob("*"))
            remove_temporary([*out.glob("*"), *inside])
        folder.write_summary("running")
        if alone:
            remove_journals(out)
        for product in folder.products:
            (out / product.name).mkdir(exist_ok=True)
    except OSError as error:
        raise cannot_write(Path(error.filename or out), error) from error
    return folder


def check_place(out: Path, *, overwrite: bool = False, forbidden: Path | None = None) -> None:
    """Refuse a folder that no settings make fit, before anything is computed for it.

    Args:
        out: the folder; nothing in it is changed.
        overwrite: as for `prepare_output`.
        forbidden: the capture.

    Raises:
        UserError: it is a capture or a file, cannot be written, or holds something else.
    """
    _check_no_capture(out, forbidden)
    check_writable(out)
    if not overwrite:
        _summaries(out)


def _check_no_capture(out: Path, forbidden: Path | None) -> None:
    """Refuse a folder whose depth/ may be what a sensor measured: not even --overwrite means it."""
    if forbidden is not None and out.resolve() == forbidden.resolve():
        what = "the output folder is the capture itself"
        raise UserError(what, out, "name another folder with --out")
    if any((out / name).is_dir() for name in ("color", "pose")):
        raise UserError("the output folder is a capture", out, "name another folder with --out")


def _earlier(
    out: Path, wanted: Mapping[str, Any], scaled_by: float | None, *, overwrite: bool
) -> list[dict[str, Any]]:
    """The summaries of earlier runs, which this one continues unless it overwrites.

    Raises:
        UserError: there is something else, or they had other settings.
    """
    earlier = _summaries(out, alone=not overwrite)
    if overwrite:
        return earlier
    if earlier and earlier[0]["settings"] != wanted:
        raise _other_settings(out, earlier[0], wanted, scaled_by)
    return earlier


def check_continues(out: Path, settings: Mapping[str, Any], scaled_by: float | None = None) -> None:
    """Whether a run would go on with an earlier one, as far as some of its settings tell.

    Args:
        out: the folder; nothing in it is changed.
        settings: those that are known so far, of the prediction as well; with the value None
            those that are there only where they are asked for.
        scaled_by: what the capture is multiplied with.

    Raises:
        UserError: the earlier run had others.
    """
    wanted = json.loads(json.dumps(plain(settings)))
    for earlier in _summaries(out)[:1]:
        found = earlier["settings"]
        predict = found.get("predict")
        if not isinstance(predict, dict):  # of another version
            continue
        known = {name: found.get(name) for name in wanted if name != "predict"}
        known["predict"] = {name: predict.get(name) for name in wanted["predict"]}
        if known != wanted:
            raise _other_settings(out, earlier | {"settings": known}, wanted, scaled_by)


def _other_settings(
    out: Path, earlier: Mapping[str, Any], wanted: Mapping[str, Any], scaled_by: float | None
) -> UserError:
    what = f"an earlier run had other settings ({difference(earlier, wanted, scaled_by)})"
    return UserError(what, out / SUMMARY, "name another folder, or add --overwrite")


def _summaries(out: Path, *, alone: bool = True) -> list[dict[str, Any]]:
    """Those of earlier runs.

    Raises:
        UserError: there is none beside other things, and they are to be ``alone``.
    """
    # Listed before the summaries are read: what another shard has made by now has a summary.
    found = sorted(os.listdir(out)) if out.exists() else []
    others = [name for name in found if not TEMPORARY.match(name) and not LOCK.fullmatch(name)]
    names = [SUMMARY, *filter(SHARD_SUMMARY.fullmatch, others)]
    earlier = [read for name in names if (read := read_summary(out / name)) is not None]
    if alone and others and not earlier:
        what = f"the output folder holds something else ({', '.join(others[:3])})"
        raise UserError(what, out, "name an empty folder, or add --overwrite")
    return earlier


def _recorded(out: Path, shard: tuple[int, int], ids: Sequence[str]) -> dict[str, Any]:
    """Records of a run that was stopped; of a shard's first run, those of its frames by others."""
    own = read_summary(out / SUMMARY if shard[1] == 1 else shard_summary(out, shard))
    if own is not None:
        return dict(own["frames"])
    of_all = (read_summary(out / SUMMARY) or {}).get("frames", {})
    return {id: of_all[id] for id in ids if id in of_all}


def _mark_stopped(out: Path, shard: tuple[int, int]) -> None:
    """Killed while maps are removed, the folder does not pass for complete."""
    for path in {out / SUMMARY, shard_summary(out, shard)}:
        summary = read_summary(path)
        if summary is not None and summary.get("status") == "complete":
            write_json(path, summary | {"status": "stopped"})


def _remove_earlier(
    folder: OutputFolder, ids: set[str], earlier: Sequence[Mapping[str, Any]], *, alone: bool
) -> None:
    """Remove what earlier runs wrote of these frames, and what shows it."""
    out = folder.path
    remove_beside(out, ids, earlier[0]["settings"] if earlier else None)
    _remove_frames(out, ids)
    if alone:
        _remove_shard_summaries(out)
    folder.remove_first()


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
