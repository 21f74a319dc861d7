"""Rows that are done, one JSON line each: what was stopped goes on where it was."""

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from deltas_nets.evaluate.record import Row, finite
from deltas_nets.outputs.atomic_files import cannot_write, plain

__all__ = ["Journal", "key_of"]


def key_of(what: Mapping[str, Any]) -> str:
    """The fingerprint of everything that decides a row; the order of the names does not matter.

    Example:
        >>> key_of({"a": 1, "b": (2, 3)}) == key_of({"b": [2, 3], "a": 1})
        True
    """
    text = json.dumps(plain(what), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


class Journal:
    """The rows of one file, by their keys.

    Args:
        file: is made with the first row.
    """

    def __init__(self, file: Path) -> None:
        self.file = file
        self._rows = _read(file)

    def __contains__(self, key: str) -> bool:
        return key in self._rows

    def __getitem__(self, key: str) -> dict[str, Any]:
        return self._rows[key]

    def add(self, key: str, row: Row) -> None:
        """Write a row to the disk.

        Raises:
            UserError: the system refuses.
        """
        kept = finite(row)
        line = json.dumps({"key": key, "row": kept}, allow_nan=False)
        try:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            with self.file.open("a", encoding="utf-8") as opened:
                # A line that a killed run left half written is ended first.
                opened.write(("" if _whole(self.file) else "\n") + line + "\n")
                opened.flush()
                os.fsync(opened.fileno())
        except OSError as error:
            raise cannot_write(self.file, error) from error
        self._rows[key] = kept


def _whole(file: Path) -> bool:
    content = file.read_bytes()
    return not content or content.endswith(b"\n")


def _read(file: Path) -> dict[str, dict[str, Any]]:
    """Rows by key; lines that are half written are left out, and measured again."""
    rows: dict[str, dict[str, Any]] = {}
    if not file.is_file():
        return rows
    for line in file.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            entry = json.loads(line)
            rows[entry["key"]] = dict(entry["row"])
        except (ValueError, KeyError, TypeError):
            continue
    return rows
