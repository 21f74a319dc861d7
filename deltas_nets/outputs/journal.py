"""A journal: what is known of each finished frame, on the disk before its files are.

A summary of thousands of frames is too long to be written after each of them. So a line for each is
added to a file beside it, ``summary.records.jsonl``, which is removed when the summary holds them,
and read when a run that was killed goes on.
"""

import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from deltas_nets.outputs.atomic_files import cannot_write, plain

__all__ = ["Journal", "read_journals", "remove_journals"]

RECORDS = re.compile(r"summary(\.\d+-of-\d+)?\.records\.jsonl")


class Journal:
    """The journal of one run.

    Args:
        summary: the summary beside which it lies.
    """

    def __init__(self, summary: Path) -> None:
        self.path = summary.with_suffix(".records.jsonl")

    def add(self, id: str, record: Mapping[str, Any]) -> None:
        """Add a line and bring it to the disk.

        Raises:
            UserError: the system refuses.
        """
        line = json.dumps([id, plain(record)], allow_nan=False)
        try:
            with self.path.open("a", encoding="utf-8") as file:
                # Starts a new line: the last one of a killed run may be cut.
                file.write(f"\n{line}\n")
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise cannot_write(self.path, error) from error

    def remove(self) -> None:
        """Remove it; the summary holds all of it."""
        self.path.unlink(missing_ok=True)


def read_journals(folder: Path) -> dict[str, Any]:
    """What the killed runs of a folder had recorded, by frame; a line that was cut is no record."""
    records: dict[str, Any] = {}
    for file in _files(folder):
        try:
            lines = file.read_text(encoding="utf-8", errors="replace").splitlines()
        except FileNotFoundError:  # of another shard, which has written its summary just now
            continue
        for line in lines:
            try:
                id, record = json.loads(line)
            except ValueError:
                continue
            records[id] = record
    return records


def remove_journals(folder: Path) -> None:
    """Remove the journals of all runs."""
    for file in _files(folder):
        file.unlink(missing_ok=True)


def _files(folder: Path) -> list[Path]:
    files = folder.iterdir() if folder.is_dir() else ()
    return sorted(file for file in files if RECORDS.fullmatch(file.name))
