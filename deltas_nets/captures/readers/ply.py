"""Points of a PLY file: x, y, z and perhaps red, green, blue of its vertices."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deltas_nets.captures.points import Observations, SparsePoints
from deltas_nets.errors import UserError

__all__ = ["read_points"]

REMEDY = "write the points as PLY again, or remove the file"
HEADER_LIMIT = 65536
"""Bytes."""
TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}


def read_points(path: Path) -> SparsePoints:
    """The vertices, without those that are not finite; nobody says which frames see them.

    Raises:
        UserError: it is no PLY file, is cut short, or has no vertices with x, y and z.
    """
    with path.open("rb") as file:
        head, form, count, columns = _header(path, file.read(HEADER_LIMIT))
        file.seek(head)
        left = path.stat().st_size - head
        if form == "ascii":
            table = _text(path, file.read(), count, len(columns))
            named = {name: table[:, place] for place, (name, _) in enumerate(columns)}
        else:
            kind = np.dtype([(name, ORDERS[form] + TYPES[type]) for name, type in columns])
            if count * kind.itemsize > left:
                what = f"the points are cut short: {count} of {kind.itemsize} bytes in {left}"
                raise UserError(what, path, REMEDY)
            records = np.frombuffer(file.read(count * kind.itemsize), kind)
            named = {name: records[name] for name, _ in columns}
    if not {"x", "y", "z"} <= named.keys():
        raise UserError("the points have no x, y and z", path, REMEDY)
    xyz = np.stack([named[axis].astype(np.float64) for axis in "xyz"], axis=-1)
    rgb = np.zeros((count, 3), np.uint8)
    if {"red", "green", "blue"} <= named.keys():
        colours = np.stack([named[name] for name in ("red", "green", "blue")], axis=-1)
        rgb = np.nan_to_num(colours).clip(0, 255).astype(np.uint8)
    good = np.isfinite(xyz).all(axis=-1)
    error = np.full(int(good.sum()), np.nan)
    return SparsePoints(xyz[good], rgb[good], error, Observations.none())


def _header(path: Path, start: bytes) -> tuple[int, str, int, list[tuple[str, str]]]:
    """Where the vertices begin, the form, their number, and names and types of their columns."""
    end = start.find(b"end_header")
    line_end = start.find(b"\n", end)
    if not start.startswith(b"ply") or end < 0 or line_end < 0:
        raise UserError("the points are no PLY file", path, REMEDY)
    form, count, columns, elements = "", -1, [], []
    for line in start[:end].decode("ascii", "replace").splitlines():
        words = line.split()
        if words[:1] == ["format"] and len(words) > 1:
            form = words[1]
        elif words[:1] == ["element"] and len(words) == 3:
            elements.append(words[1])
            if words[1] == "vertex" and words[2].isdigit() and len(words[2]) < 12:
                count = int(words[2])
        elif words[:1] == ["property"] and elements[-1:] == ["vertex"]:
            columns.append((words[-1], words[1] if len(words) == 3 else "list"))
    known = all(type in TYPES for _, type in columns)
    names = {name for name, _ in columns}
    if form not in (*ORDERS, "ascii") or count < 0 or not known or len(names) < len(columns):
        raise UserError("the points are a PLY file of an unknown form", path, REMEDY)
    if elements[:1] != ["vertex"] or not columns:
        raise UserError("the PLY file does not begin with vertices", path, REMEDY)
    return line_end + 1, form, count, columns


def _text(path: Path, data: bytes, count: int, width: int) -> NDArray[np.float64]:
    words = (
        data.split(maxsplit=count * width)[: count * width] if 2 * count <= len(data) + 1 else []
    )
    if len(words) < count * width:
        raise UserError(f"the points are cut short: {count} are announced", path, REMEDY)
    try:
        return np.array(words, dtype=np.float64).reshape(count, width)
    except ValueError as error:
        raise UserError("the points hold a word where a number should be", path, REMEDY) from error
