"""What is written in a format is what is read from it."""

import os
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import MakeCapture
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from posed_captures import IN_TRANSFORMS, captures, image_of
from run_command import Run, assert_one_line
from small_capture import write_capture

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import Lens
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.saving import WRITERS, save_capture
from deltas_nets.captures.scaled import in_metres
from deltas_nets.errors import UserError

NUMBERED = st.lists(st.integers(0, 10**6).map(str), min_size=1, max_size=4, unique=True)
KEEP_TRACKS = ("own", "colmap", "colmap-bin")


def saved_and_read(capture: Capture, to: str) -> Capture:
    with tempfile.TemporaryDirectory() as folder:
        save_capture(capture, Path(folder) / "out", to)
        read = open_capture(Path(folder) / "out")
        assert all(frame.image_path.is_file() for frame in read.frames.values())
        return read


def assert_same_cameras(read: Capture, written: Capture) -> None:
    """Ids, poses, intrinsics and sizes to 1e-6; lenses as functions."""
    assert list(read.frames) == list(written.frames)
    assert not read.lost and not read.doubts
    np.testing.assert_allclose(
        read.frames.cam_from_world, written.frames.cam_from_world, rtol=0, atol=1e-6
    )
    np.testing.assert_allclose(read.frames.K, written.frames.K, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(read.frames.image_sizes, written.frames.image_sizes)
    for mine, theirs in zip(read.frames.values(), written.frames.values(), strict=True):
        assert (mine.lens is None) == (theirs.lens is None)
        if mine.lens is not None and theirs.lens is not None:
            length = len(theirs.lens.coefficients)
            assert mine.lens.coefficients[:length] == pytest.approx(theirs.lens.coefficients)
            assert not any(mine.lens.coefficients[length:])


def assert_same_points(read: Capture, written: Capture) -> None:
    if written.points is None:
        assert read.points is None
        return
    assert read.points is not None
    for mine, theirs in zip(read.points[:3], written.points[:3], strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-9)
    rows = [
        sorted(
            zip(*map(tuple, (seen.point, seen.frame, seen.pixels.round(6))), strict=True), key=str
        )
        for seen in (read.points.seen, written.points.seen)
    ]
    assert str(rows[0]) == str(rows[1])


@pytest.mark.parametrize("to", KEEP_TRACKS)
@given(capture=captures())
def test_a_round_trip_keeps_cameras_lenses_ids_and_tracks(to: str, capture: Capture) -> None:
    read = saved_and_read(capture, to)
    assert_same_cameras(read, capture)
    assert_same_points(read, capture)
    assert [frame.lens for frame in read.frames.values()] == [
        frame.lens for frame in capture.frames.values()
    ]


@given(capture=captures(IN_TRANSFORMS), metric=st.booleans())
def test_transforms_json_keeps_cameras_lenses_and_points(capture: Capture, metric: bool) -> None:
    read = saved_and_read(replace(capture, metric=metric), "transforms")
    assert_same_cameras(read, capture)
    assert read.metric == metric
    if capture.points is not None and read.points is not None:
        np.testing.assert_array_equal(read.points.xyz, capture.points.xyz)
        np.testing.assert_array_equal(read.points.rgb, capture.points.rgb)


@given(capture=captures((), ids=NUMBERED, one_camera=True), unit=st.floats(0.01, 100))
def test_scannets_export_keeps_what_is_in_metres(capture: Capture, unit: float) -> None:
    centred = np.array([[9.0, 0, 3.5], [0, 9, 2.5], [0, 0, 1]])
    frames = [
        replace(frame, K=centred, image_size=(6, 8), image_path=image_of((6, 8)))
        for frame in capture.frames.values()
    ]
    known = in_metres(replace(capture, frames=Frames.of(frames)), unit)
    read = saved_and_read(known, "scannet")
    assert_same_cameras(read, known)
    assert read.metric
    shift = read.frames.cam_from_world[:, :3, 3] / unit
    np.testing.assert_allclose(shift, capture.frames.cam_from_world[:, :3, 3], atol=1e-6)


@pytest.mark.parametrize("to", ["own", "transforms", "scannet"])
@pytest.mark.parametrize("placing", ["copy", "link"])
def test_depth_comes_along(tmp_path: Path, to: str, placing: str) -> None:
    capture = open_capture(write_capture(tmp_path / "in", depth_size=(24, 32)))
    save_capture(capture, tmp_path / "out", to, placing=placing)
    read = open_capture(tmp_path / "out")
    assert read.metric
    for frame, original in zip(read.frames.values(), capture.frames.values(), strict=True):
        np.testing.assert_array_equal(frame.read_depth(), original.read_depth())
        assert frame.image_path.read_bytes() == original.image_path.read_bytes()
        assert frame.image_path.is_symlink() == (placing == "link")


def test_a_depth_camera_aside_is_kept_by_ours_and_registered_elsewhere(tmp_path: Path) -> None:
    folder = write_capture(tmp_path / "in", num_frames=2)
    aside = np.eye(4)
    aside[0, 3] = 0.1
    capture = open_capture(folder)
    moved = [replace(frame, cam_from_depth=aside) for frame in capture.frames.values()]
    capture = replace(capture, frames=Frames.of(moved, folder))
    save_capture(capture, tmp_path / "own")
    save_capture(capture, tmp_path / "transforms", "transforms")
    own = open_capture(tmp_path / "own").frame(0)
    np.testing.assert_allclose(own.cam_from_depth, aside, atol=1e-12)
    np.testing.assert_allclose(own.depth_K, capture.frame(0).depth_K)
    registered = open_capture(tmp_path / "transforms").frame(0)
    assert registered.cam_from_depth is None
    assert registered.read_depth()[24, 20:60] == pytest.approx(2.5)


@pytest.mark.parametrize("to", WRITERS)
def test_our_own_keys_survive(tmp_path: Path, to: str) -> None:
    capture = open_capture(write_capture(tmp_path / "in", num_frames=3))
    sources = {"0": ("1", "2"), "1": ("0",), "2": ()}
    ranges = np.array([[0.5, 4.0], [0.25, 3], [1, 9]])
    save_capture(replace(capture, sources=sources, depth_ranges=ranges), tmp_path / "out", to)
    read = open_capture(tmp_path / "out")
    assert read.sources == (sources if to == "own" else None)
    assert (read.depth_ranges is not None) == (to == "own")


def _bent(capture: Capture) -> Capture:
    lens = Lens("THIN_PRISM_FISHEYE", (0.1,) * 8)
    frames = [replace(frame, lens=lens) for frame in capture.frames.values()]
    return replace(capture, frames=Frames.of(frames))


def _skewed(capture: Capture) -> Capture:
    K = capture.frame(0).K.copy()
    K[0, 1] = 1.0
    frames = [replace(frame, K=K) for frame in capture.frames.values()]
    return replace(capture, frames=Frames.of(frames))


def _image_gone(capture: Capture) -> Capture:
    frames = [replace(frame, image_path=Path("gone.png")) for frame in capture.frames.values()]
    return replace(capture, frames=Frames.of(frames))


@pytest.mark.parametrize(
    ("to", "change"),
    [
        ("scannet", _bent),
        ("scannet", lambda capture: replace(capture, metric=False)),
        ("transforms", _bent),
        ("transforms", _skewed),
        ("colmap", _skewed),
        ("own", _skewed),
        *((to, _image_gone) for to in WRITERS),
    ],
)
def test_what_a_format_cannot_hold_is_refused_and_nothing_is_left(
    tmp_path: Path, to: str, change: Callable[[Capture], Capture]
) -> None:
    capture = change(open_capture(write_capture(tmp_path / "in")))
    with pytest.raises(UserError):
        save_capture(capture, tmp_path / "new" / "out", to)
    assert os.listdir(tmp_path) == ["in"]


def test_ids_that_are_no_numbers_get_a_table(run: Run, tmp_path: Path) -> None:
    folder = write_capture(tmp_path / "in", num_frames=2)
    save_capture(open_capture(folder), tmp_path / "own")
    text = (tmp_path / "own" / "frames.json").read_text()
    (tmp_path / "own" / "frames.json").write_text(text.replace('"id": 1', '"id": "left eye"'))
    said = run("convert", tmp_path / "own", tmp_path / "out", "--to", "scannet")
    assert "ids.txt" in said.err
    assert (tmp_path / "out" / "ids.txt").read_text() == "0 0\n1 left eye\n"
    assert list(open_capture(tmp_path / "out").frames) == ["0", "1"]


def test_the_command_says_what_it_leaves_out_and_never_overwrites(run: Run, tmp_path: Path) -> None:
    folder = write_capture(tmp_path / "in")
    said = run("convert", folder, tmp_path / "out", "--to", "colmap-bin", "--images", "link")
    assert "4 frames" in said.out and "depth" in said.err and "metre" in said.err
    assert_one_line(run("convert", folder, tmp_path / "out"), "not empty")
    assert len(os.listdir(tmp_path)) == 2


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (b"", "the file is empty"),
        (b"<html>", "cannot be decoded"),
        (-400, "truncated"),
        (None, "image is 32x24"),
    ],
)
def test_images_that_nobody_can_use_are_said(
    run: Run, tmp_path: Path, content: bytes | int | None, what: str
) -> None:
    image = write_capture(tmp_path / "in") / "color" / "1.jpg"
    if content is None:
        Image.new("RGB", (32, 24)).save(image)
    else:
        image.write_bytes(image.read_bytes()[:content] if isinstance(content, int) else content)
    said = run("convert", tmp_path / "in", tmp_path / "out")
    assert "1 image cannot be used (1)" in said.err and what in said.err and "4 frames" in said.out


def test_sensor_depth_that_nobody_can_use_is_said_where_it_is_written(
    run: Run, tmp_path: Path
) -> None:
    depth = write_capture(tmp_path / "in") / "depth" / "1.png"
    depth.write_bytes(depth.read_bytes()[:60])
    said = run("convert", tmp_path / "in", tmp_path / "out")
    assert "1 depth image cannot be used (1)" in said.err and "4 frames" in said.out
    model = run("convert", tmp_path / "in", tmp_path / "model", "--to", "colmap")
    assert "cannot be used" not in model.err  # it has no depth


def test_a_sensor_is_no_folder_of_maps(make_capture: MakeCapture, tmp_path: Path, run: Run) -> None:
    given = ("convert", make_capture(), tmp_path / "out", "--to", "own", "--depths", "sensor")
    assert_one_line(run(*given), "--depths sensor")
    assert not (tmp_path / "out").exists()


def test_of_two_that_write_one_folder_the_first_is_kept_whole(
    capture: Capture, tmp_path: Path
) -> None:
    out = tmp_path / "out"

    def other(id: str) -> None:
        if not out.exists():
            save_capture(capture, out, "transforms")

    with pytest.raises(UserError, match="the folder is not empty"):
        save_capture(capture, out, report=other)
    assert len(open_capture(out).frames) == len(capture.frames)
    assert not (out / "frames.json").exists() and not list(tmp_path.glob(".*"))


@pytest.mark.parametrize("full", [True, False])
def test_what_is_to_blame_for_a_copy_that_fails_is_named(
    capture: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, full: bool
) -> None:
    def fail(source: Path, target: Path) -> None:
        if full:
            raise OSError(28, "No space left on device", str(source), None, str(target))
        raise PermissionError(13, "Permission denied", str(source))

    monkeypatch.setattr(shutil, "copyfile", fail)
    with pytest.raises(UserError) as raised:
        save_capture(capture, tmp_path / "out")
    said, image = raised.value, capture.frames.at(0).image_path
    assert said.where == (tmp_path / "out" if full else image)
    assert ("cannot be written" if full else "cannot be read") in said.what
    assert list(tmp_path.glob("*out*")) == []
