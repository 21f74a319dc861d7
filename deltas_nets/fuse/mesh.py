"""A triangle mesh, its seams and its small parts."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["Mesh", "joined", "without_small_parts"]


class Mesh(NamedTuple):
    """Triangles.

    Attributes:
        vertices: ``(N, 3)`` float64 in the world.
        colors: ``(N, 3)`` uint8.
        faces: ``(F, 3)`` int32 of vertices, anticlockwise as seen from outside.
    """

    vertices: NDArray[np.float64]
    colors: NDArray[np.uint8]
    faces: NDArray[np.int32]

    @classmethod
    def empty(cls) -> "Mesh":
        """No triangle."""
        nothing = np.zeros((0, 3))
        return cls(nothing, nothing.astype(np.uint8), nothing.astype(np.int32))

    def areas(self) -> NDArray[np.float64]:
        """``(F,)`` of the triangles."""
        a, b, c = (self.vertices[self.faces[:, corner]] for corner in range(3))
        areas: NDArray[np.float64] = np.linalg.norm(np.cross(b - a, c - a), axis=-1) / 2
        return areas

    def with_faces(self, kept: NDArray[np.bool_]) -> "Mesh":
        """The mesh less the faces where ``kept`` ``(F,)`` is False, and vertices of no face."""
        faces = self.faces[kept]
        used = np.zeros(len(self.vertices), dtype=bool)
        used[faces] = True
        place = (np.cumsum(used) - 1).astype(np.int32)
        return Mesh(self.vertices[used], self.colors[used], place[faces])


def joined(parts: Sequence[Mesh], seams: Sequence[NDArray[np.int64]]) -> Mesh:
    """Meshes as one, in which vertices on their common borders are one too.

    Args:
        parts: meshes.
        seams: ``(N, 3)`` of each: integers that are the same of vertices that are to be one, at
            least 0; negative of those that are on no border.
    """
    if not parts:
        return Mesh.empty()
    seam = np.concatenate(seams)
    firsts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = np.concatenate([part.faces + first for part, first in zip(parts, firsts, strict=False)])
    border = np.flatnonzero(seam[:, 0] >= 0)
    place = np.arange(len(seam))
    if len(border):
        size = seam.max(axis=0) + 1
        name = (seam[border, 0] * size[1] + seam[border, 1]) * size[2] + seam[border, 2]
        _, first, same = np.unique(name, return_index=True, return_inverse=True)
        place[border] = border[first][same]
    vertices = np.concatenate([part.vertices for part in parts])
    colors = np.concatenate([part.colors for part in parts])
    merged = Mesh(vertices, colors, place[faces].astype(np.int32))
    return merged.with_faces(np.ones(len(faces), dtype=bool))


def without_small_parts(mesh: Mesh, least_area: float) -> Mesh:
    """The mesh less parts that hang together with no other and have less than some area.

    Parts of a twentieth of the largest one or more stay: a mesh of coarse voxels is no speck.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    if len(mesh.faces) == 0:
        return mesh
    edges = mesh.faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    count = len(mesh.vertices)
    ones = np.ones(len(edges), dtype=np.int8)
    graph = coo_array((ones, (edges[:, 0], edges[:, 1])), shape=(count, count))
    _, part = connected_components(graph, directed=False)
    part_of_face = part[mesh.faces[:, 0]]
    areas = np.bincount(part_of_face, weights=mesh.areas())
    return mesh.with_faces(areas[part_of_face] >= min(least_area, areas.max() / 20))
