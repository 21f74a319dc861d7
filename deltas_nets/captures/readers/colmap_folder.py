"""Where in a folder COLMAP's models are, and which of them is meant."""

import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from deltas_nets.captures.colmap_model import ColmapModel
from deltas_nets.captures.ids import natural_key
from deltas_nets.captures.readers.colmap_binary import read_binary_model
from deltas_nets.captures.readers.colmap_text import read_text_model
from deltas_nets.captures.readers.names import IMAGE_SUFFIXES
from deltas_nets.errors import UserError

__all__ = ["FoundModels", "find_models", "has_model", "is_binary", "read_model"]

PLACES = ("sparse", "colmap/sparse", "distorted/sparse")
"""Where programs put the model, or a folder for each of several."""
STEMS = ("cameras", "images", "points3D")
DEPTH = 3
"""Folders down to which a model of another name is searched."""
ENTRIES_LIMIT = 200_000
"""Files and folders that are looked at to find one."""
FOLDERS_LIMIT = 10_000
"""Folders, as deep as each other, that are looked into."""


class FoundModels(NamedTuple):
    """Models of one capture.

    Attributes:
        captures: folders that the images may be in, best first.
        models: folders and the number of their images, most first.
    """

    captures: tuple[Path, ...]
    models: tuple[tuple[Path, int], ...]


def has_model(path: Path) -> bool:
    """Whether a folder is a model or holds one, or a file is of one."""
    if path.is_file():
        return path.stem in STEMS and _is_model(path.parent)
    return not _has_other_poses(path) and next(_models(path), None) is not None


def find_models(path: Path) -> FoundModels:
    """The models of the capture in a folder.

    Args:
        path: its folder, one of its files, or a folder that `has_model`.

    Raises:
        UserError: models of several captures are there.
    """
    start = path.parent if path.is_file() else path
    if _is_model(start):
        start = Path(os.path.abspath(start))  # its images may be in a folder above
    models = sorted(_models(start), key=lambda model: (len(model.parts), natural_key(str(model))))
    captures = sorted({_capture_of(model, start) for model in models})
    if len(captures) > 1:
        names = ", ".join(str(capture.relative_to(start)) for capture in captures[:5])
        more = f" and {len(captures) - 5} more" if len(captures) > 5 else ""
        what = f"the folder holds {len(captures)} captures ({names}{more})"
        raise UserError(what, start, "name one of them")
    counts = [(model, _count_images(model)) for model in models]
    # Sorting is stable: of models that are as good, the first.
    counts.sort(key=lambda counted: -counted[1])
    around = (start,) if captures[0].is_relative_to(start) and captures[0] != start else ()
    return FoundModels((captures[0], *around), tuple(counts))


def read_model(folder: Path) -> ColmapModel:
    """The model of a folder, binary where both kinds are there, as COLMAP reads it.

    Raises:
        UserError: a file is missing or malformed, or the files are of both kinds.
    """
    _check_one_kind(folder)
    return read_binary_model(folder) if is_binary(folder) else read_text_model(folder)


def _check_one_kind(folder: Path) -> None:
    """Refuse a model of which a file is there as the other kind alone."""
    wanted, other = (".bin", ".txt") if is_binary(folder) else (".txt", ".bin")
    for stem in STEMS[:2]:
        missing, instead = (folder / f"{stem}{suffix}" for suffix in (wanted, other))
        if not missing.is_file() and instead.is_file():
            what = f"the model mixes {wanted} and {other}: it has {instead.name}, no {missing.name}"
            remedy = "export all files as one kind (colmap model_converter --output_type TXT)"
            raise UserError(what, folder, remedy)


def is_binary(folder: Path) -> bool:
    """Whether the model of a folder is read from binary files."""
    return sum((folder / f"{stem}.bin").is_file() for stem in STEMS) >= 2


def _models(path: Path) -> Iterator[Path]:
    """Folders of models: this one, or those at the usual place, or any."""
    if _is_model(path):
        yield path
        return
    for place in PLACES:
        folder = path / place
        inside = [folder, *_folders_in(folder)[0]] if folder.is_dir() else []
        found = [model for model in inside if _is_model(model)]
        if found:
            yield from found
            return
    yield from _search(path)


def _search(path: Path) -> Iterator[Path]:
    level, budget = [path], ENTRIES_LIMIT
    for _ in range(DEPTH):
        below: list[Path] = []
        for parent in level:
            try:
                folders, entries = _folders_in(parent)
            except OSError:
                if parent == path:
                    raise
                continue  # what is not ours to read is no part of a capture
            budget -= entries
            if budget < 0:
                return
            below += folders
        # To ask each whether it holds a model takes far longer than to list it.
        level = below[:FOLDERS_LIMIT]
        yield from (folder for folder in level if _is_model(folder))


def _folders_in(path: Path) -> tuple[list[Path], int]:
    """Folders, sorted, and of how many entries; links are left out, so that there is no cycle.

    Folders of captures with poses of their own are left out, too.
    """
    count, names = 0, []
    with os.scandir(path) as entries:
        for entry in entries:
            count += 1
            if entry.is_dir(follow_symlinks=False) and not entry.name.startswith("."):
                names.append(entry.name)
            if count > ENTRIES_LIMIT:
                break
    folders = [path / name for name in sorted(names)]
    return [folder for folder in folders if not _has_other_poses(folder)], count


def _has_other_poses(folder: Path) -> bool:
    """Whether this is ScanNet's layout, whose poses are metric, whatever else it holds."""
    # Unlike pathlib's, without an error where we may not look.
    return os.path.isdir(folder / "pose")


def _is_model(path: Path) -> bool:
    """Whether two of the three files are there: a model may lack points, or be broken or mixed."""
    kinds = (".bin", ".txt")
    there = (any(os.path.isfile(path / f"{stem}{kind}") for kind in kinds) for stem in STEMS)
    return sum(there) >= 2


def _capture_of(model: Path, start: Path) -> Path:
    """The folder around a model, above folders that are only there for models.

    It is not above ``start``, the folder that a user named, unless that is a model without images.
    """
    folder = model.parent
    in_sparse = "sparse" in (model.name, folder.name)
    if folder.name == "sparse":
        folder = folder.parent
    if in_sparse and folder.name in ("colmap", "distorted"):
        folder = folder.parent
    if model != start:
        return folder if folder.is_relative_to(start) else start
    return start if not in_sparse and _may_hold_images(start) else folder


def _may_hold_images(folder: Path) -> bool:
    with os.scandir(folder) as entries:
        return any(
            entry.is_dir() or entry.name.lower().endswith(IMAGE_SUFFIXES) for entry in entries
        )


def _count_images(model: Path) -> int:
    """Images that a model says it has, without reading it."""
    if is_binary(model):
        try:
            with (model / "images.bin").open("rb") as file:
                return int(struct.unpack("<Q", file.read(8))[0])
        except (OSError, struct.error):
            return 0
    try:
        with (model / "images.txt").open("rb") as file:
            return sum(not line.startswith(b"#") for line in file) // 2
    except OSError:
        return 0
