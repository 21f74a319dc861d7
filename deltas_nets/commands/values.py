"""Values of flags that make no sense, told at once: before anything heavy is imported."""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from deltas_nets.commands.command import Command
from deltas_nets.errors import UserError

__all__ = [
    "at_least",
    "at_least_one",
    "check_values",
    "not_empty",
    "not_negative",
    "positive",
    "read_shard",
]

LEAST_SIDE = 32  # px


MOST_PASSES = 9


def check_values(command: Command) -> None:
    """Refuse what no command can mean by a flag of that name.

    Configs refuse the same, and more; but they are imported with the network.

    Raises:
        UserError: a value is out of its range, or a file that is to be read is not there.
    """
    for field in fields(command):  # type: ignore[arg-type]
        value = getattr(command, field.name)
        check = command.checks.get(field.name) or CHECKS.get(field.name)
        if value is not None and check is not None:
            check(value, f"--{field.name.replace('_', '-')}")
    _check_out(command)
    # Of several scenes it lies in each, and is looked for once these are known.
    sets, capture = getattr(command, "view_sets", None), getattr(command, "capture", None)
    if sets is not None and capture is not None:
        _view_sets(sets, capture)
    if getattr(command, "views", None) == 1 and getattr(command, "sensor_depth", None) is None:
        completes = hasattr(command, "sensor_depth")
        remedy = "use 2 views or more"
        if completes:
            remedy = "use 2 or more, or add --sensor-depth, which is completed then"
        raise UserError("one view alone has no depth", "--views 1", remedy)


def _check_out(command: Command) -> None:
    """Refuse to write among the files of a capture, where results would be read as its images."""
    out, capture = getattr(command, "out", None), getattr(command, "capture", None)
    if isinstance(out, Path) and isinstance(capture, Path):
        folder = capture if capture.is_dir() else capture.parent
        if out.is_dir() and out.resolve() == folder.resolve():
            what = "the output folder is the capture itself"
            raise UserError(what, out, "name another folder with --out")


def _range(value: tuple[float, float], flag: str) -> None:
    near, far = value
    if not 0 < near < far < math.inf:
        raise UserError("no range of depth", f"{flag} {near:g} {far:g}", "use 0 < NEAR < FAR")


def _size(value: tuple[int, int], flag: str) -> None:
    if min(value) < LEAST_SIDE:
        given = " ".join(map(str, value))
        raise UserError("too small", f"{flag} {given}", f"use HEIGHT WIDTH of {LEAST_SIDE} or more")


def read_shard(text: str, flag: str = "--shard") -> tuple[int, int]:
    """I and N of ``--shard I/N``.

    Raises:
        UserError: it is not of that form, or I is not among 1 to N.
    """
    match = re.fullmatch(r"(\d+)/(\d+)", text)
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise UserError("not a shard", f"{flag} {text}", "use I/N with 1 <= I <= N, as 2/4")
    return int(match[1]), int(match[2])


def at_least(least: int) -> Callable[[int, str], None]:
    """A check of a count that must be so much or more; it raises UserError where it is less."""

    def check(value: int, flag: str) -> None:
        if value < least:
            raise UserError("too few", f"{flag} {value}", f"use {least} or more")

    return check


at_least_one = at_least(1)


def not_empty(value: tuple[object, ...], flag: str) -> None:
    """A list of what is to be measured.

    Raises:
        UserError: there is nothing in it.
    """
    if not value:
        raise UserError("nothing is named", flag, "name one or more, or leave it out")


def not_negative(value: float, flag: str) -> None:
    """A distance or a seed.

    Raises:
        UserError: it is below 0.
    """
    if value < 0:
        raise UserError("too small", f"{flag} {value:g}", "use 0 or more")


def positive(value: float, flag: str) -> None:
    """A length, or anything that must be more than nothing.

    Raises:
        UserError: it is 0 or less, or infinite.
    """
    if not 0 < value < math.inf:
        raise UserError("too small or infinite", f"{flag} {value:g}", "give a positive number")


def _passes(value: int, flag: str) -> None:
    if not 1 <= value <= MOST_PASSES:
        what = "no such number of passes"
        raise UserError(what, f"{flag} {value}", f"use 1 to {MOST_PASSES}, 3 is usual")


def _positive(value: float, flag: str) -> None:
    if not 0 < value < math.inf:
        raise UserError("no scale", f"{flag} {value:g}", "give a positive number")


def _part(value: float, flag: str) -> None:
    if not 0 <= value <= 1:
        raise UserError("no confidence", f"{flag} {value:g}", "use 0 to 1")


def _capture(value: Path, _: str) -> None:
    if not value.exists():
        raise UserError("the capture does not exist", value, "check the path")


def _file(value: Path, flag: str) -> None:
    if not value.is_file():
        raise UserError("the file does not exist", f"{flag} {value}", "check the path")


def _view_sets(value: Path, capture: Path) -> None:
    from deltas_nets.captures.sets_file import sets_file

    if not sets_file(value, capture).is_file():
        what = "the file does not exist, in the capture neither"
        raise UserError(what, f"--view-sets {value}", "check the path")


def _depths(value: Path, flag: str) -> None:
    if str(value) not in ("sensor", "points"):
        _file(value, flag)


def _share(value: float, flag: str) -> None:
    if not 0 < value < 1:
        what = "no standard deviation as a share of the depth"
        raise UserError(what, f"{flag} {value:g}", "use more than 0 and less than 1")


def _intrinsics(value: str, flag: str) -> None:
    from deltas_nets.captures.camera_words import Intrinsics

    Intrinsics.parse(value, flag)


CHECKS: Mapping[str, Callable[[Any, str], object]] = {
    "shard": read_shard,
    "depth_range": _range,
    "size": _size,
    "work_size": _size,
    "views": at_least_one,
    "passes": _passes,
    "sensor_depth": _depths,
    "sensor_deviation": _share,
    "scale": _positive,
    "depth_scale": _positive,
    "min_confidence": _part,
    "memory": positive,
    "capture": _capture,
    "scale_from": _depths,
    "intrinsics": _intrinsics,
}
"""By the name of a field, which means the same in all commands."""
