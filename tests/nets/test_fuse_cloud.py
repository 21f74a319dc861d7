"""Clouds: normals, thinning; files of clouds and meshes as other programs read them."""

from pathlib import Path

import numpy as np
import pytest
import torch
from fused_scenes import SIZE, sphere_views, view_of, wall
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from deltas_nets.fuse import Cloud, CloudPoints, Mesh
from deltas_nets.fuse.cloud import normals_of
from deltas_nets.fuse.files import write_cloud_ply, write_glb, write_mesh_ply

SPHERE = sphere_views()
FAR = (4e5, 5e6, 200.0)  # metres, as of a survey


@settings(max_examples=10)
@given(slopes=st.tuples(st.floats(-1, 1), st.floats(-1, 1)))
def test_normals_of_a_plane_are_its_normal(slopes: tuple[float, float]) -> None:
    # Points with z = 2 + a x + b y; normals point against z, at the camera.
    rays = view_of(torch.ones(SIZE)).rays().double()
    a, b = slopes
    depth = 2 / (1 - a * rays[..., 0] - b * rays[..., 1])
    normals, valid = normals_of(torch.where(depth[..., None] > 0, rays * depth[..., None], 0.0))
    wanted = torch.nn.functional.normalize(torch.tensor([a, b, -1.0]).double(), dim=0)
    assert valid[SIZE[0] // 2, SIZE[1] // 2]
    assert_close(normals[valid], wanted.expand_as(normals[valid]))


def test_a_pixel_alone_has_no_normal() -> None:
    depth = torch.zeros(SIZE)
    depth[5, 5] = 1.0
    assert not normals_of(view_of(depth).points())[1].any()


def test_a_cloud_has_one_point_in_a_voxel_on_the_surface_whatever_the_order() -> None:
    clouds = []
    for views in (SPHERE, SPHERE[::-1]):
        cloud = Cloud(0.05)
        for view in views:
            cloud.add(view)
        clouds.append(cloud.points())
    one, other = clouds
    assert_close(one.points, other.points, rtol=0, atol=1e-6)
    assert len(np.unique(np.floor(one.points / 0.05), axis=0)) == len(one.points)
    radius = np.linalg.norm(one.points, axis=1, keepdims=True)
    assert abs(radius - 0.4).max() < 0.02
    assert (one.normals * one.points / radius).sum(axis=1).min() > 0.6
    assert np.median((one.normals * one.points / radius).sum(axis=1)) > 0.99


def test_points_are_means_by_inverse_variance() -> None:
    one, other = wall(2.2), wall(2.2, std=0.02)
    other.cam_from_world[2, 3] = -0.4  # so its wall is at 2.6
    cloud = Cloud(1.0)
    cloud.add(one)
    cloud.add(other)
    mean = np.full(len(cloud), (4 * 2.2 + 2.6) / 5)
    assert_close(cloud.points().points[:, 2], mean, rtol=0, atol=1e-6)


def test_a_restored_cloud_goes_on() -> None:
    half, rest = Cloud(0.05), Cloud(0.05)
    half.add(SPHERE[0])
    rest.restore(half.state())
    for cloud in (half, rest):
        cloud.add(SPHERE[1])
    assert_close(half.points().points, rest.points().points)


def square(at: tuple[float, float, float] = (0.0, 0, 0)) -> Mesh:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.5]]) + at
    colors = np.arange(12, dtype=np.uint8).reshape(4, 3)
    return Mesh(vertices, colors, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32))


@pytest.mark.parametrize("at", [(0.0, 0, 0), FAR])
def test_another_program_reads_our_meshes(tmp_path: Path, at: tuple[float, float, float]) -> None:
    trimesh = pytest.importorskip("trimesh")
    mesh = square(at)
    write_mesh_ply(tmp_path / "mesh.ply", mesh, np.array([0.0, -1, 0.5]))
    assert b"\ncomment up_in_world 0 -1 0.5\n" in (tmp_path / "mesh.ply").read_bytes()
    read = trimesh.load(tmp_path / "mesh.ply", process=False)
    assert_close(np.asarray(read.vertices), mesh.vertices, rtol=0, atol=1e-6)
    assert np.asarray(read.faces).tolist() == mesh.faces.tolist()
    assert (np.asarray(read.visual.vertex_colors)[:, :3] == mesh.colors).all()
    write_glb(tmp_path / "mesh.glb", mesh, np.array([0.0, -1, 0]))
    shown = trimesh.load(tmp_path / "mesh.glb", process=False).to_mesh()
    opengl = mesh.vertices * (1, -1, -1)  # glTF's axes
    assert_close(np.asarray(shown.vertices), opengl, rtol=0, atol=1e-6)
    write_glb(tmp_path / "mesh.glb", mesh, np.array([0.0, 0, 1]))
    scene = trimesh.load(tmp_path / "mesh.glb", process=False)
    upright = mesh.vertices[:, [0, 2, 1]] * (1, 1, -1)  # of a world whose z is up
    assert_close(np.asarray(scene.to_mesh().vertices), upright, rtol=0, atol=1e-6)
    assert scene.metadata["up_in_world"] == [0, 0, 1]
    turned = np.array(scene.metadata["gltf_from_world"])[:3, :3]
    assert_close(upright @ turned, mesh.vertices, rtol=0, atol=1e-6)  # nothing is lost


@pytest.mark.parametrize("at", [0.0, 5e6])
def test_another_program_reads_our_clouds(tmp_path: Path, at: float) -> None:
    trimesh = pytest.importorskip("trimesh")
    points = np.array([[at, 0, 0], [at + 0.001, 2, 3]])
    normals = np.array([[0, 0, 1], [0, 1, 0]], dtype=np.float32)
    cloud = CloudPoints(points, normals, np.array([[1, 2, 3], [4, 5, 6]], dtype=np.uint8))
    write_cloud_ply(tmp_path / "cloud.ply", cloud, np.array([0.0, -1, 0.5]))
    assert b"\ncomment up_in_world 0 -1 0.5\n" in (tmp_path / "cloud.ply").read_bytes()
    read = trimesh.load(tmp_path / "cloud.ply")
    assert_close(np.asarray(read.vertices), points, rtol=0, atol=1e-6)
    assert (np.asarray(read.colors)[:, :3] == cloud.colors).all()
    raw = read.metadata["_ply_raw"]["vertex"]["data"]
    assert [raw[name].tolist() for name in ("nx", "ny", "nz")] == normals.T.tolist()
