"""Volumes and their surfaces: order, shifts and weights; closed where the thing is."""

import numpy as np
import pytest
import torch
from fused_scenes import SIZE, K, sphere_views, view_of, wall
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from deltas_nets.fuse import DepthView, Mesh, Volume, surface, without_small_parts
from deltas_nets.fuse.blocks import SIDE, Blocks
from deltas_nets.fuse.lattice import distinct_names, names_of_cubes, positions_of_cubes
from deltas_nets.fuse.volume import _spread_points

VOXEL = 0.05
CUBES = st.lists(st.tuples(*[st.integers(-(2**20), 2**20 - 1)] * 3), min_size=1, max_size=20)
SPHERE = sphere_views()


def fused(views: list[DepthView], voxel: float = VOXEL, **more: object) -> Volume:
    volume = Volume(voxel, **more)  # type: ignore[arg-type]
    for view in views:
        volume.add(view)
    return volume


def edges_of(mesh: Mesh) -> np.ndarray:
    """How many faces each edge has."""
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    return np.unique(edges, axis=0, return_counts=True)[1]


@given(cubes=CUBES)
def test_a_name_is_of_one_cube_and_names_are_ordered_as_cubes_are(cubes: list[tuple]) -> None:
    positions = torch.tensor(cubes)
    assert positions_of_cubes(names_of_cubes(positions)).tolist() == positions.tolist()
    wanted = sorted(set(cubes))
    assert positions_of_cubes(distinct_names(positions)).tolist() == [list(cube) for cube in wanted]


@given(lots=st.lists(st.sets(st.integers(0, 40), max_size=12), max_size=6))
def test_blocks_are_found_where_they_were_claimed(lots: list[set[int]]) -> None:
    blocks, known = Blocks(1), dict[int, int]()
    for lot in lots:
        names = torch.tensor(sorted(lot), dtype=torch.int64)
        known |= dict(zip(names.tolist(), blocks.claim(names).tolist(), strict=True))
    found = blocks.find(torch.arange(41)).tolist()
    assert found == [known.get(name, -1) for name in range(41)]
    assert sorted(known.values()) == list(range(len(known)))


@settings(max_examples=5)
@given(order=st.permutations(range(4)))
def test_the_order_of_views_changes_nothing(order: list[int]) -> None:
    one, other = fused(SPHERE[:4]), fused([SPHERE[place] for place in order])
    assert_close(one.blocks.names, other.blocks.names)
    sums = [volume.blocks.read(volume.blocks.slots) for volume in (one, other)]
    assert_close(*sums, rtol=1e-5, atol=1e-2)  # weights are 1e4


def test_threads_change_nothing() -> None:
    one, other = fused(SPHERE[:4]), fused(SPHERE[:4], threads=2)
    assert_close(*(volume.blocks.read(volume.blocks.slots) for volume in (one, other)))


def test_voxels_hold_the_mean_signed_distance_of_all_views() -> None:
    """Against each voxel looked up in each view, one by one."""
    rows, columns = torch.meshgrid(*map(torch.arange, SIZE), indexing="ij")
    slant = 0.002 * rows + 0.001 * columns
    walls = [wall(0.95), wall(0.98, x=0.1, std=0.02)]
    aside = torch.zeros(4, 4, dtype=torch.float64)
    aside[:2, 3] = 0.0137  # no voxel is seen between two pixels
    views = [
        view._replace(depth=view.depth + slant, cam_from_world=view.cam_from_world + aside)
        for view in walls
    ]
    volume = fused(views)
    cubes = positions_of_cubes(volume.blocks.names)
    place = int(torch.randint(len(cubes), (1,), generator=torch.Generator().manual_seed(0)))
    sums = volume.blocks.read(volume.blocks.slots[place : place + 1])[:, 0]
    for voxel in range(0, SIDE**3, 7):
        inside = torch.tensor([voxel // SIDE**2, voxel // SIDE % SIDE, voxel % SIDE])
        point = ((cubes[place] * SIDE + inside).double() + 0.5) * VOXEL
        weight = distance = 0.0
        for view in views:
            x, y, z = K @ (view.cam_from_world[:3, :3] @ point + view.cam_from_world[:3, 3])
            column, row = round(float(x / z)), round(float(y / z))
            if z > 0 and 0 <= column < SIZE[1] and 0 <= row < SIZE[0]:
                signed = float(view.depth[row, column] - z) / volume.truncation
                if abs(signed) < 1:
                    one = float(view.std[row, column]) ** -2
                    weight, distance = weight + one, distance + one * signed
        assert_close(sums[:2, voxel], torch.tensor([weight, distance]), rtol=1e-3, atol=1e-1)


def test_the_points_of_a_wall_that_faces_a_camera_are_around_its_axis() -> None:
    for cell in (1, 4, 16):  # pixels, of which the image has a multiple
        points = _spread_points(wall(1.0), (cell + 0.5) / float(K[0, 0]))
        assert_close(points.mean(dim=0), torch.tensor([0.0, 0, 1]), rtol=0, atol=1e-5)


@settings(max_examples=10)
@given(near=st.floats(0.9, 1.1), apart=st.floats(0.0, 0.08), ratio=st.floats(0.3, 3.0))
def test_the_surface_is_the_mean_by_inverse_variance(
    near: float, apart: float, ratio: float
) -> None:
    views = [wall(near), wall(near + apart, std=0.01 * ratio)]
    mesh = surface(fused(views))
    mean = (near + (near + apart) / ratio**2) / (1 + ratio**-2)
    assert_close(mesh.vertices[:, 2], np.full(len(mesh.vertices), mean), rtol=0, atol=2e-4)


def test_a_surface_looks_at_the_cameras_and_has_their_colour() -> None:
    mesh = surface(fused([wall(1.0)]))
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    assert (np.cross(b - a, c - a)[:, 2] < 0).all()  # cameras are at smaller z
    assert (mesh.colors == 90).all()


@pytest.mark.parametrize("voxel", [0.05, 0.02])
def test_the_surface_of_a_sphere_is_closed_and_round(voxel: float) -> None:
    """Blocks of many groups: a seam would be a hole."""
    mesh = surface(fused(sphere_views(0.6), voxel))
    mesh = without_small_parts(mesh, 0.1)
    assert set(edges_of(mesh)) == {2}
    assert len(mesh.vertices) - len(edges_of(mesh)) + len(mesh.faces) == 2  # Euler
    radius = np.linalg.norm(mesh.vertices, axis=1)
    assert abs(radius.mean() - 0.6) < 0.2 * voxel
    assert abs(mesh.areas().sum() / (4 * np.pi * 0.36) - 1) < 0.08


def test_a_far_world_is_as_good() -> None:
    at = (4e5, 5e6, 200.0)  # metres, as of a survey
    near = surface(fused(sphere_views()))
    far = surface(fused(sphere_views(at=at), origin=torch.tensor(at).double()))
    assert abs(len(far.vertices) - len(near.vertices)) < 0.01 * len(near.vertices)
    radius = np.linalg.norm(far.vertices - at, axis=1)
    assert abs(np.median(radius) - 0.4) < 0.2 * VOXEL


def test_a_restored_volume_goes_on() -> None:
    half, rest = fused(SPHERE[:3]), Volume(VOXEL)
    rest.restore({name: tensor.clone() for name, tensor in half.state().items()})
    for volume in (half, rest):
        volume.add(SPHERE[3])
    assert_close(*(volume.blocks.read(volume.blocks.slots) for volume in (half, rest)))


def test_nothing_seen_is_no_surface() -> None:
    volume = fused([view_of(torch.zeros(SIZE))])
    assert len(volume.blocks) == 0
    assert len(surface(volume).faces) == 0


def test_specks_are_removed() -> None:
    speck = torch.zeros(SIZE)
    speck[10:18, 10:18] = 0.5
    mesh = surface(fused([wall(1.0), view_of(speck)], 0.02))
    clean = without_small_parts(mesh, 100 * 0.02**2)
    assert mesh.vertices[:, 2].min() < 0.6
    assert clean.vertices[:, 2].min() > 0.9
    assert len(clean.faces) > 0.9 * len(mesh.faces)
