"""Meshes and clouds: read from PLY files, and made small enough to be shown."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deltas_nets.captures.readers.ply import read_points
from deltas_nets.errors import UserError

__all__ = ["Surface", "read_surface", "thinned"]

PLAIN = 190
"""Grey of what has no colours."""
ROUNDS, MOST_OF_IT = 8, 0.6
"""Cells that are tried, and the share of what is allowed that is enough."""
SMALLEST = 1e-9
"""Side of a box around points that are all in one place."""
FAR = 4
"""Times the side of a box around most points; what is farther from the middle is left out."""


class Surface(NamedTuple):
    """Points, or a mesh of them.

    Attributes:
        xyz: ``(N, 3)`` in the world.
        rgb: ``(N, 3)``.
        faces: ``(M, 3)`` positions of the corners; None where the points are all there is.
    """

    xyz: NDArray[np.float64]
    rgb: NDArray[np.uint8]
    faces: NDArray[np.int64] | None = None


_CORNERS = np.dtype([("count", "u1"), ("corners", "<i4", 3)])


def read_surface(path: Path) -> Surface:
    """The vertices of a PLY file and, where it is binary and has them, its triangles.

    Raises:
        UserError: the file is no PLY file, is cut short, or has faces of another form.
    """
    vertices = read_points(path)
    content = path.read_bytes()
    header = content[: content.find(b"end_header")].decode("ascii", "replace")
    elements = [line.split()[1:] for line in header.splitlines() if line.startswith("element")]
    stated = {words[0]: words[1] for words in elements if len(words) == 2}
    rgb = vertices.rgb
    if not re.search(r"property (uchar|uint8) red\b", header):
        rgb = np.full_like(rgb, PLAIN)
    faces_stated = stated.get("face", "0")
    count = int(faces_stated) if re.fullmatch("[0-9]{1,11}", faces_stated) else -1
    if count == 0:
        return Surface(vertices.xyz, rgb)
    form = "write triangles as binary little-endian PLY: list uchar int vertex_indices"
    known = "format binary_little_endian" in header and elements[-1][:1] == ["face"]
    if not known or not 0 < count * _CORNERS.itemsize <= len(content):
        raise UserError("the faces cannot be read", path, form)
    if len(vertices.xyz) != int(stated["vertex"]):
        what = "the faces cannot be read: some of the vertices are not finite"
        raise UserError(what, path, "write the mesh without those")
    start = len(content) - count * _CORNERS.itemsize
    table = np.frombuffer(content, _CORNERS, count, start)
    faces = table["corners"].astype(np.int64)
    if (table["count"] != 3).any() or faces.min() < 0 or faces.max() >= len(vertices.xyz):
        raise UserError("the faces are not triangles of the file's vertices", path, form)
    return Surface(vertices.xyz, rgb, faces)


def thinned(surface: Surface, most: int) -> Surface:
    """As much of a surface as may be shown: without what is far away from all the rest.

    Points that are close to each other are merged, in a grid that is as fine as there may be
    points.

    Args:
        surface: points, or a mesh.
        most: points, or faces of a mesh, that are left at most.
    """
    surface = _without_far(surface)
    if _size(surface) <= most:
        return surface
    cell, found = _side(surface.xyz) / most**0.5, None
    for _ in range(ROUNDS):
        merged = _merged(surface, cell)
        count = _size(merged)
        if count <= most:
            found = merged
        if MOST_OF_IT * most <= count <= most:
            return merged
        # A surface's points are as many as the inverse square of what they are apart.
        cell *= 1.05 * (max(count, 1) / most) ** 0.5
    if found is None:  # no cell holds two of them, or all are in one place
        some = slice(None, None, -(-len(surface.xyz) // most))
        found = Surface(surface.xyz[some], surface.rgb[some])
    return found


def _without_far(surface: Surface) -> Surface:
    """What is near to where most of it is: the rest would make that a dot."""
    if not len(surface.xyz):
        return surface
    middle, reach = np.median(surface.xyz, axis=0), FAR * _side(surface.xyz)
    near = np.abs(surface.xyz - middle).max(axis=1) <= reach
    if near.all():
        return surface
    faces = surface.faces
    if faces is not None:
        faces = (np.cumsum(near) - 1)[faces[near[faces].all(axis=1)]]
    return Surface(surface.xyz[near], surface.rgb[near], faces)


def _side(xyz: NDArray[np.float64]) -> float:
    """The longest side of a box around most points."""
    low, high = np.percentile(xyz, (2, 98), axis=0)
    side = float((high - low).max()) or float(np.ptp(xyz, axis=0).max())
    return max(side, SMALLEST)


def _size(surface: Surface) -> int:
    return len(surface.xyz if surface.faces is None else surface.faces)


def _merged(surface: Surface, cell: float) -> Surface:
    """One point, the mean, for each cell of a grid that holds any."""
    place = np.floor((surface.xyz - surface.xyz.min(axis=0)) / cell).astype(np.int64)
    spans = place.max(axis=0) + 1
    key = (place[:, 0] * spans[1] + place[:, 1]) * spans[2] + place[:, 2]
    _, group, count = np.unique(key, return_inverse=True, return_counts=True)

    def mean(values: NDArray[np.generic]) -> NDArray[np.float64]:
        sums = [np.bincount(group, column, len(count)) for column in values.T.astype(np.float64)]
        return np.stack(sums, axis=1) / count[:, None]

    xyz, rgb = mean(surface.xyz), np.rint(mean(surface.rgb)).astype(np.uint8)
    if surface.faces is None:
        return Surface(xyz, rgb)
    faces = group[surface.faces]
    a, b, c = faces.T
    faces = _turned(faces[(a != b) & (b != c) & (c != a)])
    if len(count) < 2**21:  # or the names of triangles overflow; there are too many then anyhow
        name = (faces[:, 0] * len(count) + faces[:, 1]) * len(count) + faces[:, 2]
        faces = faces[np.unique(name, return_index=True)[1]]
    return Surface(xyz, rgb, faces)


def _turned(faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Triangles that begin with their smallest corner, so that equal ones are equal."""
    first = faces.argmin(axis=1)[:, None]
    return np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1)
