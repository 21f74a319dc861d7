"""What a page is made of: colours that mean numbers, few points, and frames that fit."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from small_maps import mesh_of

from deltas_nets.errors import UserError
from deltas_nets.page.budget import choose
from deltas_nets.page.colours import (
    CONFIDENCE,
    ERROR,
    NONE,
    Scale,
    coloured,
    depth_scale,
    lookup_table,
    ticks_of,
)
from deltas_nets.page.html import _camera
from deltas_nets.page.scene import Camera
from deltas_nets.page.surfaces import Surface, read_surface, thinned
from deltas_nets.page.write import BYTES_OF_CAMERA

# Colours


@given(low=st.floats(1e-3, 1e3), ratio=st.floats(1.3, 100), share=st.floats(0, 1))
def test_a_value_is_read_back_from_its_colour(low: float, ratio: float, share: float) -> None:
    scale = Scale("turbo_r", low, low * ratio, "m", log=True)
    value = low * ratio**share
    colour = coloured(np.array([[value]], np.float32), scale)[0, 0]
    place = np.square(lookup_table(scale).astype(int) - colour).sum(axis=1).argmin() / 255
    # Neighbours of turbo's colours are at most a step from the nearest.
    assert low * ratio**place == pytest.approx(value, rel=2 * np.log(ratio) / 255)


@pytest.mark.parametrize("scale", [CONFIDENCE, ERROR, Scale("turbo_r", 1, 2, "m", log=True)])
def test_no_colour_is_near_the_grey_of_the_unknown(scale: Scale) -> None:
    unknown = coloured(np.ones((1, 2), np.float32), scale, known=np.array([[False, True]]))
    assert tuple(unknown[0, 0]) == NONE != tuple(unknown[0, 1])
    far = np.abs(lookup_table(scale).astype(int) - NONE).max(axis=1)
    assert far.min() > 20  # what a JPEG changes is less


@given(low=st.floats(1e-4, 1e5), ratio=st.floats(1.05, 1e4), log=st.booleans())
def test_ticks_are_few_round_and_where_they_say(low: float, ratio: float, log: bool) -> None:
    scale = Scale("turbo_r", low, low * ratio, "m", log=log)
    ticks = ticks_of(scale)
    assert 2 <= len(ticks) <= 8
    for place, text in ticks:
        assert -1e-6 <= place <= 1 + 1e-6
        assert scale.place(np.array(float(text))) == pytest.approx(place, abs=1e-5)


def test_the_scale_of_depth_spans_most_of_it_and_never_nothing() -> None:
    many = np.geomspace(1, 9, 1000).astype(np.float32)
    scale = depth_scale(many, "m")
    assert scale.low == pytest.approx(1, rel=0.05) and scale.high == pytest.approx(9, rel=0.05)
    for few in (np.array([2.5], np.float32), np.zeros(0, np.float32)):
        assert depth_scale(few, "m").high > 1.1 * depth_scale(few, "m").low


# Surfaces


@given(
    points=arrays.arrays(np.float64, (60, 3), elements=st.floats(-5, 5)), most=st.integers(1, 70)
)
def test_thinned_points_are_few_and_among_the_others(points: np.ndarray, most: int) -> None:
    rgb = np.full((60, 3), 7, np.uint8)
    found = thinned(Surface(points, rgb), most)
    assert len(found.xyz) == len(found.rgb) <= most
    assert (found.xyz >= points.min(axis=0) - 1e-9).all()
    assert (found.xyz <= points.max(axis=0) + 1e-9).all()
    assert (found.rgb == 7).all()


def test_a_thinned_mesh_keeps_its_shape(tmp_path: Path) -> None:
    mesh = mesh_of(tmp_path)
    assert mesh.faces is not None
    twice = mesh._replace(faces=np.concatenate([mesh.faces, np.roll(mesh.faces, 1, axis=1)]))
    few = thinned(twice, 800)
    assert few.faces is not None and 400 < len(few.faces) <= 800
    assert few.faces.max() < len(few.xyz)
    corners = np.sort(few.faces, axis=1)
    assert (np.diff(corners) > 0).all() and len(np.unique(corners, axis=0)) == len(corners)
    corners = few.xyz[few.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.linalg.norm(normals, axis=1).sum() / 2 == pytest.approx(1.2, rel=0.2)  # m^2
    assert (normals[:, 2] < 0).all() or (normals[:, 2] > 0).all()  # no face is turned over
    assert np.abs(few.xyz[:, 2] - 0.1 * np.sin(9 * few.xyz[:, 0])).max() < 0.02  # m
    assert thinned(mesh, 10**6) is mesh


def test_a_point_far_away_does_not_cost_the_rest() -> None:
    near = np.random.default_rng(0).uniform(0, 1, (500, 3))
    far = np.concatenate([near, [[1e9, 0, 0]]])
    found = thinned(Surface(far, np.zeros(far.shape, np.uint8)), 10**6)
    np.testing.assert_array_equal(found.xyz, near)


def test_a_mesh_is_read_as_trimesh_reads_it(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    mesh_of(tmp_path)
    ours, theirs = read_surface(tmp_path / "mesh.ply"), trimesh.load(tmp_path / "mesh.ply")
    assert ours.faces is not None
    np.testing.assert_allclose(ours.xyz[ours.faces], theirs.vertices[theirs.faces], atol=1e-6)
    theirs.export(tmp_path / "again.ply")
    again = read_surface(tmp_path / "again.ply")
    np.testing.assert_allclose(again.xyz, theirs.vertices, atol=1e-6)


@pytest.mark.parametrize("cut", [1, 5000, 10**6])
def test_a_mesh_that_is_cut_short_is_refused(tmp_path: Path, cut: int) -> None:
    mesh_of(tmp_path)
    file = tmp_path / "mesh.ply"
    file.write_bytes(file.read_bytes()[:-cut])
    with pytest.raises(UserError) as error:
        read_surface(file)
    assert error.value.where == file


def _changed(folder: Path, *changes: tuple[bytes, bytes]) -> Path:
    mesh_of(folder)
    file = folder / "mesh.ply"
    data = file.read_bytes()
    for old, new in changes:
        assert old in data
        data = data.replace(old, new, 1)
    file.write_bytes(data)
    return file


def test_colours_of_either_name_of_a_byte_are_shown(tmp_path: Path) -> None:
    names = (b"red", b"green", b"blue")
    changes = [(b"uchar " + name, b"uint8 " + name) for name in names]
    read = read_surface(_changed(tmp_path, *changes))
    np.testing.assert_array_equal(read.rgb, mesh_of(tmp_path).rgb)


FAULTS = {
    "a vertex that is not finite": (b"end_header\n" + bytes(4), b"end_header\n\x00\x00\xc0\x7f"),
    "a number of faces in words": (b"element face 3042", b"element face many"),
    "fewer than no faces": (b"element face 3042", b"element face -3042"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_mesh_that_is_damaged_is_refused(tmp_path: Path, fault: str) -> None:
    file = _changed(tmp_path, FAULTS[fault])
    with pytest.raises(UserError, match="the faces cannot be read"):
        read_surface(file)


# Budget


def test_a_camera_takes_no_more_than_is_kept_for_it() -> None:
    turned = np.full((4, 4), -0.12345678)
    turned[:3, 3] = -1.2345678e-7
    camera = Camera("0", turned, (-0.12345678,) * 4)
    text = json.dumps(_camera(camera, np.zeros(3), 12345))
    assert len(text) + len(", ") <= BYTES_OF_CAMERA


@given(count=st.integers(1, 3000), room=st.integers(10**5, 10**7), each=st.integers(1000, 400_000))
def test_frames_are_chosen_to_fit(count: int, room: int, each: int) -> None:
    ids = list(map(str, range(count)))
    chosen = choose(ids, room, lambda _, longest: each * longest**2 // 640**2)
    assert chosen.ids[0] == ids[0] and chosen.ids[-1] == ids[-1]
    whole = len(chosen.ids) * (each * chosen.longest**2 // 640**2)
    assert whole <= room or len(chosen.ids) <= 2
    assert len(chosen.ids) == count or chosen.longest == 320
