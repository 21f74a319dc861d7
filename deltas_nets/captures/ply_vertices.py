"""Vertices of binary PLY files as they are written: records of numbers, and the header of these."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["header_of", "vertices_of", "vertices_type"]

FINE_ENOUGH = 1000.0
"""Metres from the origin up to which points are written in float32, whose steps are 0.06 mm there.
Beyond, as of surveyed (UTM) coordinates, they are written in float64."""
_AXES = {"xyz": ("x", "y", "z"), "normal": ("nx", "ny", "nz"), "rgb": ("red", "green", "blue")}
_NAMES = {"f8": "double", "f4": "float", "u1": "uchar"}


def vertices_type(*names: str, double: bool) -> np.dtype[np.void]:
    """The records of vertices with ``xyz``, ``normal`` or ``rgb``; normals are always float32."""
    codes = {"xyz": "<f8" if double else "<f4", "normal": "<f4", "rgb": "u1"}
    return np.dtype([(name, codes[name], 3) for name in names])


def vertices_of(*, double: bool | None = None, **fields: ArrayLike) -> NDArray[np.void]:
    """Records ``(N,)`` of fields ``(N, 3)``; of doubles, by default, where float is too coarse."""
    if double is None:
        double = bool(np.abs(np.asarray(fields["xyz"])).max(initial=0) > FINE_ENOUGH)
    vertices = np.empty(len(np.asarray(fields["xyz"])), vertices_type(*fields, double=double))
    for name, values in fields.items():
        vertices[name] = values
    return vertices


def header_of(vertices: np.dtype[np.void], count: int, *more: str) -> bytes:
    """The header of so many vertices, and further lines."""
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    for name in vertices.names or ():
        kind = _NAMES[vertices[name].base.str[1:]]
        lines += [f"property {kind} {axis}" for axis in _AXES[name]]
    return "\n".join([*lines, *more, "end_header", ""]).encode("ascii")
