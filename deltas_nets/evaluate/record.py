"""Stored results: what was measured, how, on what and with what. One JSON format for all tables.

Commands that measure write such a file, and pages of results are made from these files alone. A row
is flat, so that a table, a figure or a spreadsheet can be made of it without knowing who wrote it.
"""

import json
import math
import os
import platform
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from deltas_nets import __version__
from deltas_nets.errors import UserError
from deltas_nets.outputs.atomic_files import plain, write_json

__all__ = [
    "Record",
    "Row",
    "Value",
    "command_line",
    "finite",
    "machine",
    "read_record",
    "versions",
    "write_record",
]

WRITER = "deltas record"
"""Stands in the file and tells records from other JSON."""
FORMAT = 1

Value = str | int | float | bool | None
Row = Mapping[str, Value]

PACKAGES = ("torch", "kornia", "numpy", "scikit-image")


@dataclass(frozen=True)
class Record:
    """One table of results.

    Example:
        >>> record = Record("detectors", rows=[{"detector": "orb", "repeatability": 0.61}])
        >>> record.rows[0]["detector"]
        'orb'
    """

    table: str
    """What was measured, in a word or two: "depth", "detectors", "ablation points"."""
    protocol: Mapping[str, Any] = field(default_factory=dict)
    """Everything that decides the numbers besides data and weights: thresholds, sizes, seeds,
    ranges, which view sets."""
    command: str = ""
    """What a person types to measure it again; see :func:`command_line`."""
    data: Sequence[Mapping[str, Any]] = ()
    """Each capture, split or set of rooms: its name, how many view sets or pairs, what else says
    which they are. Where they lie on a disk is nobody's business."""
    weights: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Of each network by the name that rows use: what `weights_record` says, its sha256 at least;
    empty for methods without any."""
    rows: Sequence[Row] = ()
    """The table: names of columns to values. Units stand in the protocol or in the names; what was
    not or could not be measured is None, and a row may say why under "note"."""
    versions: Mapping[str, str] = field(default_factory=lambda: versions())
    """Of deltas, Python and the packages that compute."""
    machine: Mapping[str, Any] = field(default_factory=lambda: machine())
    """What computed: times mean nothing without it."""

    def __post_init__(self) -> None:
        for row in self.rows:
            for name, value in row.items():
                if not isinstance(value, Value):
                    raise ValueError(f"{name} of a row must be a plain value, got {value!r}")


def write_record(path: Path, record: Record, *, beside: Mapping[str, Any] | None = None) -> None:
    """Write a record, atomically; numbers that JSON has not, as NaN, become null.

    Args:
        path: the file.
        record: the table.
        beside: more that the file holds, under other names; :func:`read_record` passes over it.

    Raises:
        UserError: the system refuses.
    """
    content = asdict(record) | {"rows": [finite(row) for row in record.rows]}
    more = {name: _with_null(value) for name, value in (beside or {}).items()}
    write_json(path, {"writer": WRITER, "format": FORMAT, **content, **more})


def read_record(path: str | Path) -> Record:
    """A record that :func:`write_record` wrote.

    Raises:
        UserError: the file is missing, or holds something else.
    """
    path, remedy = Path(path), "name a file of results that deltas wrote"
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UserError("no such results", path, remedy) from None
    except (OSError, ValueError) as error:
        raise UserError(f"results cannot be read ({error})", path, remedy) from None
    if not isinstance(content, dict) or content.get("writer") != WRITER:
        raise UserError("not a file of results", path, remedy)
    if content.get("format") != FORMAT:
        what = f"results of another version ({content.get('format')})"
        raise UserError(what, path, "measure again, or install that version")
    names = [one.name for one in fields(Record)]
    missing = [name for name in names if name not in content]
    if missing:
        raise UserError(f"results without {', '.join(missing)}", path, remedy)
    try:
        return Record(**{name: content[name] for name in names})
    except (AttributeError, TypeError, ValueError) as error:
        raise UserError(f"results cannot be read ({error})", path, remedy) from None


def finite(row: Row) -> dict[str, Value]:
    """A row with None for numbers that are not finite: they were not measured.

    Example:
        >>> finite({"error": float("nan"), "points": 300})
        {'error': None, 'points': 300}
    """
    values = {name: plain(value) for name, value in row.items()}
    kept: dict[str, Value] = {}
    for name, value in values.items():
        unmeasured = isinstance(row[name], float) and isinstance(value, str)
        kept[name] = None if unmeasured or not isinstance(value, Value) else value
    return kept


def command_line(arguments: Sequence[str] | None = None) -> str:
    """The command as a shell takes it, in the folder where it was given.

    Of absolute paths in that folder the way from it stays, and of others the last name alone, for
    which whoever runs it again puts a folder or a link of that name there.

    Args:
        arguments: with the program's name first; those of this process if not given.

    Example:
        >>> command_line(["/opt/bin/deltas", "evaluate", "/data/the walk", "--views", "3"])
        "deltas evaluate 'the walk' --views 3"
    """
    program, *given = sys.argv if arguments is None else arguments
    path = Path(program)
    words = ["python", "-m", path.parent.name] if path.name == "__main__.py" else [path.name]
    return shlex.join([*words, *map(_shown, given)])


def versions(*more: str) -> dict[str, str]:
    """Of deltas, Python and the packages that compute, by name.

    Args:
        more: other packages that took part, as pycolmap; those not installed are left out.
    """
    found = {"deltas": __version__, "python": platform.python_version()}
    for name in (*PACKAGES, *more):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def machine(device: str = "cpu") -> dict[str, Any]:
    """What computes: processor, its cores that may be used, and the device.

    Args:
        device: of torch; of a CUDA device its name is recorded.
    """
    record: dict[str, Any] = {"processor": _processor(), "cores": _cores(), "device": device}
    if device.startswith("cuda"):
        import torch

        record["device"] = torch.cuda.get_device_name(device)
    return record


def _shown(argument: str) -> str:
    flag, equals, value = argument.partition("=")
    if equals and os.path.isabs(value):
        return f"{flag}={_shown(value)}"
    if not os.path.isabs(argument):
        return argument
    here, path = Path.cwd(), Path(os.path.normpath(argument))
    return str(path.relative_to(here)) if path.is_relative_to(here) else path.name


def _with_null(value: object) -> object:
    """The same, with None for numbers that are not finite, however deep."""
    if isinstance(value, Mapping):
        return {name: _with_null(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_with_null(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _processor() -> str:
    """Its name where the system tells; Linux tells in a file."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return named[0] if named else platform.processor() or platform.machine()


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
