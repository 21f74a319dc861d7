"""A folder of captures, of which one has to be named."""

from collections.abc import Collection, Sequence
from itertools import islice
from pathlib import Path
from typing import Protocol

from deltas_nets.captures.ids import ids_in_words, natural_key
from deltas_nets.errors import UserError

__all__ = ["several_captures"]

MOST = 200
"""Folders that are looked into."""


class Recogniser(Protocol):
    """What a reader knows before it reads."""

    def recognises(self, path: Path) -> bool:
        """Whether a folder looks like its format."""


def several_captures(
    path: Path, readers: Collection[Recogniser], reader: Recogniser | None
) -> UserError | None:
    """Why a folder is refused that is no capture itself, but whose folders are.

    Args:
        path: a folder.
        readers: of all formats.
        reader: one that found a capture inside of the folder; None if none did.
    """
    found = [folder for folder in _folders(path) if any(one.recognises(folder) for one in readers)]
    if reader is None:
        others = found
    else:
        # Parts of one capture are all of one format: models, reconstructions.
        others = [folder for folder in found if not reader.recognises(folder)]
    if not others or (reader is not None and len(found) < 2):
        return None
    names = ids_in_words(folder.name for folder in found)
    many = "a capture" if len(found) == 1 else f"{len(found)} captures"
    what = f"the folder holds {many} ({names}) and is none itself"
    return UserError(what, path, f"name one of them, as {found[0]}")


def _folders(path: Path) -> Sequence[Path]:
    inside = (folder for folder in path.iterdir() if not folder.name.startswith("."))
    some = [folder for folder in islice(inside, MOST) if folder.is_dir()]
    return sorted(some, key=lambda folder: natural_key(folder.name))
