"""Files of clouds and meshes."""

from pathlib import Path
from typing import Any

import numpy as np

from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.ply_vertices import header_of, vertices_of
from deltas_nets.captures.upright import y_up_from_world
from deltas_nets.extras import check_extra
from deltas_nets.fuse.cloud import CloudPoints
from deltas_nets.fuse.mesh import Mesh
from deltas_nets.outputs.atomic_files import write_atomically

__all__ = ["check_mesh_extra", "write_cloud_ply", "write_glb", "write_mesh_ply"]


def write_cloud_ply(path: Path, cloud: CloudPoints, up: FloatArray | None = None) -> None:
    """Write points with normals and colours as binary PLY; see `write_mesh_ply`."""
    vertices = vertices_of(xyz=cloud.points, normal=cloud.normals, rgb=cloud.colors)
    content = header_of(vertices.dtype, len(vertices), *_upward(up)) + vertices.tobytes()
    write_atomically(path, lambda file: file.write(content))


def write_mesh_ply(path: Path, mesh: Mesh, up: FloatArray | None = None) -> None:
    """Write a mesh with coloured vertices as binary PLY.

    Coordinates are the world's, wherever its ``up`` is, which a comment in the header says: float,
    or double where they are too large.
    """
    vertices = vertices_of(xyz=mesh.vertices, rgb=mesh.colors)
    more = (f"element face {len(mesh.faces)}", "property list uchar int vertex_indices")
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("vertices", "<i4", 3)])
    faces["count"], faces["vertices"] = 3, mesh.faces

    def write(file: Any) -> None:
        file.write(header_of(vertices.dtype, len(vertices), *_upward(up), *more))
        file.write(vertices.tobytes())
        file.write(faces.tobytes())

    write_atomically(path, write)


def _upward(up: FloatArray | None) -> list[str]:
    return [] if up is None else ["comment up_in_world " + " ".join(f"{axis:.9g}" for axis in up)]


def check_mesh_extra(path: Path) -> None:
    """Is the package installed that GLB needs?

    Raises:
        UserError: it is not.
    """
    otherwise = "ask for mesh.ply with --mesh"
    check_extra("mesh", "trimesh", wanted_by="GLB needs", where=path, otherwise=otherwise)


def write_glb(path: Path, mesh: Mesh, up: FloatArray) -> None:
    """Write a mesh as GLB, which browsers and Blender show upright: y is up in glTF.

    The scene's extras say how the world was turned, and where it is up. GLB has float32 alone:
    coordinates count from the middle of the mesh, and a node moves and turns them.

    Args:
        path: the file.
        mesh: in the world.
        up: ``(3,)`` of the world.
    """
    import trimesh

    middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    local = trimesh.Trimesh(
        mesh.vertices - middle, mesh.faces, vertex_colors=mesh.colors, process=False
    )
    turned, moved = np.eye(4), np.eye(4)
    turned[:3, :3] = y_up_from_world(up)
    moved[:3, 3] = middle
    scene = trimesh.Scene()
    scene.add_geometry(local, node_name="mesh", transform=turned @ moved)
    scene.metadata["up_in_world"] = up.tolist()
    scene.metadata["gltf_from_world"] = turned.tolist()
    content = scene.export(file_type="glb")
    write_atomically(path, lambda file: file.write(content))
