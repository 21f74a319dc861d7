"""Folders that our own commands filled: maps, previews and meshes, none of them a photo."""

import os
from collections.abc import Sequence

__all__ = ["is_ours"]

RECORDS = ("summary.json", "fuse.json")
"""Files that such a folder has one of, from its first moment on."""
_MARK = b'"writer": "deltas '
_HEAD = 200
"""Bytes of a record in which its mark is."""


def is_ours(folder: str, files: Sequence[str]) -> bool:
    """Whether a folder that holds these files was filled by a command of ours.

    The record is opened: other programs write a summary.json, too.
    """
    return any(_is_marked(os.path.join(folder, name)) for name in RECORDS if name in files)


def _is_marked(path: str) -> bool:
    try:
        with open(path, "rb") as file:
            return _MARK in file.read(_HEAD)
    except OSError:
        return False
