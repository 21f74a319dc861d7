"""Depth, confidence, points and JSON as files that are whole whenever they exist.

Every file is written under a temporary name beside it, brought to the disk and renamed, which is
atomic there.
"""

import contextlib
import json
import math
import os
import re
import secrets
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from deltas_nets.errors import UserError

__all__ = [
    "TEMPORARY",
    "cannot_write",
    "check_writable",
    "plain",
    "read_depth_png",
    "read_points_ply",
    "write_atomically",
    "write_confidence_png",
    "write_depth_png",
    "write_json",
    "write_points_ply",
]

TEMPORARY = re.compile(r"\..*\.deltas-tmp$")
"""Names of files that a killed run left half written."""
MAX_MILLIMETRES = 65534  # 65535 means "none" to some readers

VERTEX = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)])
PLY_HEADER = """ply
format binary_little_endian 1.0
element vertex {count}
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
end_header
"""


def write_depth_png(path: Path, depth: ArrayLike) -> None:
    """Write ``(H, W)`` metres as 16-bit millimetres.

    Unknown depth (0, negative, NaN, infinite) becomes 0; known depth stays known: below half
    a millimetre it is written as 1, beyond 65.534 m as that.
    """
    metres = np.asarray(depth, dtype=np.float64)
    known = np.isfinite(metres) & (metres > 0)
    millimetres = np.rint(1000 * np.where(known, metres, 0)).clip(1, MAX_MILLIMETRES)
    image = Image.fromarray(np.where(known, millimetres, 0).astype(np.uint16))
    write_atomically(path, lambda file: image.save(file, format="PNG"))


def read_depth_png(path: Path) -> NDArray[np.float32]:
    """``(H, W)`` float32 metres of a file of `write_depth_png`, 0 where there is none."""
    with Image.open(path) as image:
        return (np.asarray(image) / np.float64(1000)).astype(np.float32)


def write_confidence_png(path: Path, probability: ArrayLike) -> None:
    """Write probabilities ``(H, W)`` in [0, 1] as 8-bit 0..255; NaN becomes 0."""
    values = np.nan_to_num(np.asarray(probability, dtype=np.float64), nan=0.0).clip(0, 1)
    image = Image.fromarray(np.rint(255 * values).astype(np.uint8))
    write_atomically(path, lambda file: image.save(file, format="PNG"))


def write_points_ply(path: Path, points: ArrayLike, colors: ArrayLike) -> None:
    """Write points ``(N, 3)`` in metres with colors ``(N, 3)`` uint8 as binary PLY.

    Points that are not finite are left out; viewers stumble over them.
    """
    xyz, rgb = np.asarray(points, dtype=np.float32), np.asarray(colors)
    if xyz.ndim != 2 or xyz.shape[1] != 3 or rgb.shape != xyz.shape or rgb.dtype != np.uint8:
        raise ValueError(
            f"points and colors must have shape (N, 3), colors uint8, "
            f"got {xyz.shape} and {rgb.shape} {rgb.dtype}"
        )
    finite = np.isfinite(xyz).all(axis=1)
    vertices = np.empty(int(finite.sum()), dtype=VERTEX)
    vertices["xyz"], vertices["rgb"] = xyz[finite], rgb[finite]
    content = PLY_HEADER.format(count=len(vertices)).encode("ascii") + vertices.tobytes()
    write_atomically(path, lambda file: file.write(content))


def read_points_ply(path: Path) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Points ``(N, 3)`` and colors ``(N, 3)`` of a file of `write_points_ply`."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    found = re.search(rb"element vertex (\d+)", header)
    if found is None or header + b"end_header\n" != PLY_HEADER.format(count=int(found[1])).encode(
        "ascii"
    ):
        raise UserError("the file is not one of ours", path, "read it with a PLY library")
    vertices = np.frombuffer(body, dtype=VERTEX, count=int(found[1]))
    return vertices["xyz"].copy(), vertices["rgb"].copy()


def write_json(path: Path, obj: object) -> None:
    """Write JSON that a person can read; see `plain` for what becomes of other types."""
    content = json.dumps(plain(obj), indent=2, allow_nan=False) + "\n"
    write_atomically(path, lambda file: file.write(content.encode("utf-8")))


def write_atomically(path: Path, write: Callable[[IO[bytes]], object]) -> None:
    """Call ``write`` with a temporary file beside ``path``, then rename it to ``path``.

    What is written is on the disk before the new name is, so that a power cut leaves the old file
    or the new one.

    Raises:
        UserError: the system refuses; nothing is left behind then.
    """
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.deltas-tmp")
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
        if isinstance(error, OSError):
            raise cannot_write(path, error) from error
        raise
    _sync_folder(path.parent)


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
        raise UserError("this is a file, not a folder", out, "name a folder with --out")
    parents = (out, *out.absolute().parents)
    nearest = next(folder for folder in parents if folder.exists())
    try:
        with tempfile.NamedTemporaryFile(dir=nearest, prefix=".", suffix=".deltas-tmp") as file:
            file.write(b"x")
    except OSError as error:
        raise cannot_write(out, error) from error


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
