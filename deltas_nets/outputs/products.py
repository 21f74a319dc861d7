"""Files of a frame: depth, confidence and points."""

import re
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from deltas_nets.errors import UserError
from deltas_nets.outputs.atomic_files import write_atomically

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
