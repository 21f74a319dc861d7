"""Captures that open though something in them is off: sizes, turned images, names of files."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from run_command import Run
from small_scannet import SCANNET, opened

from deltas_nets.captures.capture import Capture, Frame
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.readers.intrinsics import read_intrinsics
from deltas_nets.captures.view_sets import ViewSet, doubtful_scale
from deltas_nets.errors import UserError

MakeCapture = Callable[..., Path]


def write_depth(file: Path, size: tuple[int, int]) -> None:
    file.unlink()  # or a link would be followed
    Image.fromarray(np.full(size, 2500, np.uint16)).save(file)


def test_training_refuses_depth_of_another_size(scannet_copy: Path, tmp_path: Path) -> None:
    write_depth(scannet_copy / "scans" / "scene0000_00" / "depth" / "3.png", (48, 64))
    for cache in (None, tmp_path / "kept", tmp_path / "kept"):
        tuples = opened(replace(SCANNET, root=str(scannet_copy)), cache=cache)
        with pytest.raises(UserError, match=r"depth is 64x48, the others are 128x96, .*3.png"):
            [tuples[index] for index in range(len(tuples))]


def test_damaged_depth_is_no_obstacle_to_what_needs_none(make_capture: MakeCapture) -> None:
    folder = make_capture()
    for file in (folder / "depth").iterdir():
        file.write_bytes(b"")
    assert open_capture(folder).frame(0).depth_size is None


@given(
    right=st.floats(-0.07, 0.07), down=st.floats(-0.07, 0.07), ratio=st.sampled_from([4 / 3, 3 / 2])
)
def test_any_usual_camera_fits_its_images_and_not_those_turned(
    right: float, down: float, ratio: float, tmp_path_factory: pytest.TempPathFactory
) -> None:
    height, width = 600, round(600 * ratio)
    file = tmp_path_factory.getbasetemp() / "k.txt"
    cx, cy = width * (0.5 + right) - 0.5, height * (0.5 + down) - 0.5
    file.write_text(f"500 0 {cx} 0 500 {cy} 0 0 1")
    assert read_intrinsics(file, (height, width))[0, 2] == cx
    if max(abs(right), abs(down)) < 0.03:
        with pytest.raises(UserError, match="rotated"):
            read_intrinsics(file, (width, height))


def warnings_of(run: Run, folder: Path, out: Path, *options: object) -> list[str]:
    result = run("depth", folder, "--out", out, "--size", 32, 32, *options)
    assert result.code == 0, result.err
    return result.warnings


def test_a_principal_point_far_from_the_middle_is_a_warning(
    run: Run, make_capture: MakeCapture, tmp_path: Path
) -> None:
    folder = make_capture()
    file = folder / "intrinsic" / "intrinsic_color.txt"
    file.write_text("60 0 50 0 60 24 0 0 1")
    (said,) = warnings_of(run, folder, tmp_path / "out")
    assert said.startswith("the principal point (50, 24) is far from the middle of images of 64x48")
    assert str(file) in said
    file.write_text("60 0 46 0 60 24 0 0 1")
    assert open_capture(folder).doubts == ()


@pytest.mark.parametrize(
    ("step", "said"), [(150.0, "stand 225 m apart"), (1.5e-4, "0.000225 m apart")]
)
def test_poses_that_are_hardly_in_metres_are_a_warning(
    run: Run, make_capture: MakeCapture, tmp_path: Path, step: float, said: str
) -> None:
    folder = make_capture(step=step)
    warning, *_ = warnings_of(run, folder, tmp_path / "out")
    assert said in warning and "are the poses in metres?" in warning


@given(step=st.floats(0.003, 4.9), num_frames=st.integers(2, 4))
def test_baselines_that_suit_the_depth_range_are_no_doubt(
    tmp_path_factory: pytest.TempPathFactory, step: float, num_frames: int
) -> None:
    K, poses = np.eye(3), np.tile(np.eye(4), (num_frames, 1, 1))
    poses[:, 0, 3] = step * np.arange(num_frames)
    frames = [Frame(str(id), Path(), (48, 64), K, pose) for id, pose in enumerate(poses)]
    capture = Capture(path=Path(), frames=Frames.of(frames), lost={})
    pairs = [ViewSet(str(id), (str(id + 1),)) for id in range(num_frames - 1)]
    assert doubtful_scale(capture, pairs, (0.5, 10.0)) is None
    # Whatever the unit, as long as the range is in it.
    assert doubtful_scale(capture, pairs, (0.5 * step, 10 * step)) is None
    assert doubtful_scale(capture, pairs, (500 * step, 1000 * step)) is not None
    assert doubtful_scale(capture, [ViewSet("0", ())], (0.5, 10.0)) is None


def test_depth_of_another_shape_without_intrinsics_is_a_warning(make_capture: MakeCapture) -> None:
    folder = make_capture(depth_size=(64, 48))
    assert open_capture(folder).doubts == ()
    (folder / "intrinsic" / "intrinsic_depth.txt").unlink()
    (said,) = open_capture(folder).doubts
    assert said.startswith("depth of 48x64 is taken to show what images of 64x48 show")


def test_misnamed_images_are_left_out_with_a_warning(
    run: Run, make_capture: MakeCapture, tmp_path: Path
) -> None:
    folder = make_capture()
    color = folder / "color"
    for name in ("IMG_9.jpg", "7.webp", ".8.jpg", "notes.txt", "Thumbs.db"):
        (color / name).write_bytes(b"")
    (said,) = warnings_of(run, folder, tmp_path / "out")
    assert said == f"left out, {color / '7.webp'} and 1 more: images are N.jpg or N.png, N a number"
    (color / "7.webp").unlink()
    (said,) = warnings_of(run, folder, tmp_path / "out")
    assert f"left out, {color / 'IMG_9.jpg'}: images" in said
    assert "IMG_9.jpg" in run("evaluate", folder).err


def test_training_tells_of_misnamed_images(scannet_copy: Path, tmp_path: Path) -> None:
    color = scannet_copy / "scans" / "scene0000_00" / "color"
    (color / "IMG_9.png").write_bytes(b"")
    for cache in (None, tmp_path / "kept", tmp_path / "kept"):
        said: list[str] = []
        opened(replace(SCANNET, root=str(scannet_copy)), cache=cache, report=said.append)
        (warning,) = [line for line in said if "warning" in line]
        assert str(color / "IMG_9.png") in warning


def test_more_views_than_go_together_is_a_warning(
    run: Run, make_capture: MakeCapture, tmp_path: Path
) -> None:
    folder, sets = make_capture(), tmp_path / "sets.json"
    sets.write_text('[{"anchor": 0, "sources": [1, 2]}]')
    words = ["no map is from 100 views: there are at most 3 that go together"]
    out = tmp_path / "out"
    assert warnings_of(run, folder, out, "--views", 100, "--view-sets", sets) == words
    (said,) = warnings_of(run, folder, tmp_path / "chosen", "--views", 100)
    assert said.startswith("no map is from 100 views: there are at most ")
    assert warnings_of(run, folder, tmp_path / "few", "--views", 3, "--view-sets", sets) == []
