"""A folder of captures: the only one is meant, of several one has to be named."""

from collections.abc import Collection, Sequence
from itertools import islice
from pathlib import Path
from typing import Protocol

from deltas_nets.captures.ids import ids_in_words, natural_key
from deltas_nets.errors import UserError

__all__ = ["captures_inside", "several_captures"]

MOST = 200
"""Folders that are looked into, as deep as each other."""
DEEPEST = 3
"""Folders down to which captures are looked for."""


class Recogniser(Protocol):
    """What a reader knows before it reads."""

    def recognises(self, path: Path) -> bool:
        """Whether a folder looks like its format."""


def captures_inside(
    path: Path, readers: Collection[Recogniser], reader: Recogniser | None
) -> Sequence[Path]:
    """The captures in a folder that is none itself, all as deep in it; none where it is one.

    Args:
        path: a folder.
        readers: of all formats.
        reader: one that found a capture inside of the folder; None if none did.
    """
    found: Sequence[Path] = []
    level: Sequence[Path] = [path]
    for _ in range(DEEPEST if reader is None else 1):
        level = [inside for folder in level for inside in _folders(folder)][:MOST]
        found = [each for each in level if any(_recognised(one, each) for one in readers)]
        if found:
            break
    if reader is None:
        return found
    # Parts of one capture are all of one format: models, reconstructions.
    others = any(not reader.recognises(folder) for folder in found)
    return found if others and len(found) > 1 else []


def several_captures(path: Path, inside: Sequence[Path]) -> UserError:
    """Why a folder of captures is refused."""
    names = ids_in_words(folder.relative_to(path).as_posix() for folder in inside)
    what = f"the folder holds {len(inside)} captures ({names}) and is none itself"
    return UserError(what, path, f"name one of them, as {inside[0]}")


def _recognised(reader: Recogniser, folder: Path) -> bool:
    try:
        return reader.recognises(folder)
    except OSError:  # not ours to read
        return False


def _folders(path: Path) -> Sequence[Path]:
    try:
        inside = (folder for folder in path.iterdir() if not folder.name.startswith("."))
        some = [folder for folder in islice(inside, MOST) if folder.is_dir()]
    except OSError:  # not ours to read
        return []
    return sorted(some, key=lambda folder: natural_key(folder.name))
