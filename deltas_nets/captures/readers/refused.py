"""What is no capture yet, recognised by name, and which program makes one of it."""

import re
from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from itertools import islice
from pathlib import Path
from shlex import quote

from deltas_nets.captures.readers.files import NOT_COLOUR
from deltas_nets.captures.readers.listed import listed
from deltas_nets.captures.readers.names import IMAGE_SUFFIXES
from deltas_nets.captures.readers.other_programs import (
    COLMAP,
    LAYOUTS,
    MAIN_FILES,
    MODELS,
    OWN,
    RECORDINGS,
    TEXTS,
    Rule,
)
from deltas_nets.errors import UserError

__all__ = ["known_layout", "refusal"]

_LOOKED_AT = 10_000
"""Entries of a folder."""
_FOLDERS = 200
"""Folders that are looked into."""
_DEEPEST = 3
"""Folders down to which photos are looked for."""


def refusal(path: Path) -> UserError | None:
    """Why a folder or file that no reader recognises is refused, if it is known what it is.

    Example:
        >>> print(refusal(Path("walk.mp4")).what)
        this is a video, not a capture
    """
    if not path.is_dir():
        return _known([path], (*MODELS, *RECORDINGS), path) or _misnamed([path])
    entries = _entries(path)
    return (
        _known(entries, MODELS, path)
        or known_layout(path)
        or _misnamed(entries)
        or _known(_below(entries), MODELS, path)
        or _photos(path)
        or _known(entries, RECORDINGS, path)
    )


def _known(files: Sequence[Path], rules: Sequence[Rule], path: Path) -> UserError | None:
    heads = [(file, _head(file)) for file in files]
    for called, known, remedy in rules:
        for file, head in heads:
            if known(file, head):
                return UserError(f"this is {called}, not a capture", file, _filled(remedy, path))
    return None


def known_layout(path: Path) -> UserError | None:
    """Why a folder that is known by what is in it is refused."""
    for called, holds, remedy in LAYOUTS:
        if all(next(path.glob(pattern), None) is not None for pattern in holds):
            return UserError(f"this is {called}, not a capture", path, _filled(remedy, path))
    return None


def _misnamed(files: Sequence[Path]) -> UserError | None:
    """A file that is nearly called as one that captures are known by."""
    for file in files:
        near = get_close_matches(file.name.lower(), MAIN_FILES, n=1, cutoff=0.9)
        if near and near[0] != file.name and file.is_file():
            what = f"no capture is known by a file {file.name}"
            return UserError(what, file, f"rename it {near[0]} if it is one")
    return None


def _below(entries: Sequence[Path]) -> list[Path]:
    """What is in the folders of a folder, where programs put what they export."""
    folders = [entry for entry in entries if entry.is_dir()][:_FOLDERS]
    return [file for folder in folders for file in _entries(folder)]


def _photos(path: Path) -> UserError | None:
    # Those that are called after depth last: nothing else may be there.
    for folder in sorted(_folders(path), key=_is_of_no_colour):
        inside = _entries(folder)
        photos = sum(each.suffix.lower() in IMAGE_SUFFIXES and each.is_file() for each in inside)
        if photos > 1:
            what = f"the folder holds {photos} photos without poses"
            remedy = f"{COLMAP}; where you have poses of your own, {OWN}"
            return UserError(what, folder, _filled(remedy, path, folder))
    return None


def _folders(path: Path) -> Iterator[Path]:
    """A folder, then those in it, then those in these."""
    level = [path]
    for _ in range(_DEEPEST + 1):
        yield from level
        inside = (each for folder in level for each in _entries(folder) if _may_hold_photos(each))
        level = list(islice(inside, _FOLDERS))


def _may_hold_photos(path: Path) -> bool:
    return path.is_dir() and not (path.is_symlink() or path.name.lower().startswith(NOT_COLOUR))


def _is_of_no_colour(path: Path) -> bool:
    """Whether a word of the name, as of NAME_depth, says that no photos are there."""
    return any(word.startswith(NOT_COLOUR) for word in re.split("[_ -]", path.name.lower()))


def _entries(folder: Path) -> list[Path]:
    return sorted(islice(listed(folder), _LOOKED_AT))


def _head(path: Path) -> bytes:
    try:
        if path.suffix.lower() not in TEXTS or not path.is_file():
            return b""
        with path.open("rb") as file:
            return file.read(4096)
    except OSError:
        return b""


def _filled(remedy: str, path: Path, photos: Path | None = None) -> str:
    folder = path if path.is_dir() else path.parent
    if photos is None:
        photos = folder / "images" if (folder / "images").is_dir() else folder
    return remedy.replace("{folder}", quote(str(folder))).replace("{images}", quote(str(photos)))
