"""Files that are whole whenever they exist, and JSON.

Every file is written under a temporary name beside it, brought to the disk and renamed, which is
atomic there.
"""

import contextlib
import json
import math
import os
import re
import secrets
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import IO

import numpy as np

from deltas_nets.errors import UserError

__all__ = [
    "TEMPORARY",
    "cannot_write",
    "check_file",
    "check_writable",
    "plain",
    "remove_abandoned",
    "remove_temporary",
    "write_atomically",
    "write_json",
]

TEMPORARY = re.compile(r"\..*\.deltas-tmp$")
"""Names of files that a killed run left half written."""
ABANDONED = 3600.0
"""Seconds after which nobody writes such a file any more."""


def write_json(path: Path, obj: object) -> None:
    """Write JSON that a person can read; see `plain` for what becomes of other types."""
    content = json.dumps(plain(obj), indent=2, allow_nan=False) + "\n"
    write_atomically(path, lambda file: file.write(content.encode("utf-8")))


def write_atomically(path: Path, write: Callable[[IO[bytes]], object]) -> None:
    """Call ``write`` with a temporary file beside ``path``, then rename it to ``path``.

    What is written is on the disk before the new name is, so that a power cut leaves the old file
    or the new one.

    Raises:
        UserError: the system refuses, or a device or a pipe is there; nothing is left behind then.
    """
    _check_no_device(path)
    outer = sys.exception()
    # Not its whole name, which may be as long as names can be.
    temporary = path.with_name(f".{path.name[:40]}.{secrets.token_hex(4)}.deltas-tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # Not tempfile, whose files are private to the user: outputs follow the umask.
        with temporary.open("xb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        refusal = _refusal(error, outer)
        if refusal is not None:
            raise cannot_write(path, refusal) from error
        raise
    _sync_folder(path.parent)


def _refusal(error: BaseException, outer: BaseException | None) -> OSError | None:
    """The system's refusal behind an error: torch's, of a full disk, speaks of positions.

    Args:
        error: while a file was written.
        outer: what was being handled before; None if nothing was.
    """
    behind: BaseException | None = error
    while isinstance(behind, Exception) and behind is not outer:
        if isinstance(behind, OSError):
            return behind
        behind = behind.__context__
    return None


def remove_temporary(files: Iterable[Path]) -> None:
    """Remove those of some files that a killed run left half written."""
    for path in files:
        if TEMPORARY.match(path.name):
            path.unlink(missing_ok=True)


def remove_abandoned(folder: Path) -> None:
    """Remove what killed processes were writing into a folder that many processes share.

    What is younger than an hour may still be written by one of them.
    """
    if not folder.is_dir():
        return
    for path in folder.iterdir():
        if TEMPORARY.match(path.name):
            with contextlib.suppress(OSError):  # another process may have removed it, too
                if time.time() - path.stat().st_mtime > ABANDONED:
                    path.unlink()


def _sync_folder(folder: Path) -> None:
    """Put the names in a folder on the disk, where the system can: some know no such thing."""
    with contextlib.suppress(OSError):
        opened = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(opened)
        finally:
            os.close(opened)


def check_writable(out: Path) -> None:
    """Whether a folder can be made and filled; nothing of it is made.

    A file is written where it would be: permission bits mislead on network drives and root.

    Raises:
        UserError: it is a file, or the system refuses.
    """
    if out.exists() and not out.is_dir():
        raise UserError("this is a file, not a folder", out, "name another place")
    parents = (out, *out.absolute().parents)
    nearest = next(folder for folder in parents if folder.exists())
    try:
        with tempfile.NamedTemporaryFile(dir=nearest, prefix=".", suffix=".deltas-tmp") as file:
            file.write(b"x")
    except OSError as error:
        raise cannot_write(out, error) from error


def check_file(file: Path, *, remedy: str = "name a file") -> None:
    """Whether a file can be written, before the work whose results it is for.

    Raises:
        UserError: it is a folder, a device or a pipe, or the system refuses.
    """
    if file.is_dir():
        raise UserError("this is a folder, not a file", file, remedy)
    _check_no_device(file)
    check_writable(file.parent)


def _check_no_device(path: Path) -> None:
    """Refuse what a rename would replace for every program, as root /dev/null or /dev/stdout."""
    to_a_process = path.is_symlink() and os.readlink(path).startswith("/proc/")
    if to_a_process or (path.exists() and not path.is_file() and not path.is_dir()):
        what = "this is a device or a pipe, which cannot be replaced"
        raise UserError(what, path, "name a file")


def cannot_write(path: Path, error: OSError) -> UserError:
    """What to tell the user when the system refuses to write."""
    what = f"cannot be written ({error.strerror or error})"
    return UserError(what, path, "name a place that can be written and has space")


def plain(value: object) -> object:
    """The same as JSON knows it: tuples become lists, paths and infinities strings.

    Example:
        >>> plain({"depth_range": (0.5, float("inf")), "out": Path("maps")})
        {'depth_range': [0.5, 'inf'], 'out': 'maps'}
    """
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)  # JSON has no such numbers, and readers refuse Python's words for them
    return value
