"""BundleFusion, 3RScan, ScanNet's tools: 7-Scenes' layout with a file of the sensor's cameras."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from written_captures import NUM, SIZE, K, make_scene, sevenscenes

from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.opening import open_capture
from deltas_nets.errors import UserError


def words(matrix: FloatArray) -> str:
    whole = np.eye(4)
    whole[: len(matrix), : len(matrix)] = matrix
    return " ".join(f"{number:.17g}" for number in whole.ravel())


def write(folder: Path, *lines: str, name: str = "info.txt") -> Path:
    """The scene in two sequences, whose only intrinsics are these lines."""
    sevenscenes(folder, make_scene())
    (folder / "camera-intrinsics.txt").unlink()
    (folder / name).write_text("\n".join(("m_versionNumber = 4", *lines)))
    return folder


@pytest.mark.parametrize("name", ["info.txt", "_info.txt", "seq-01/_info.txt"])
def test_the_cameras_are_those_that_the_file_states(tmp_path: Path, name: str) -> None:
    half = np.diag([0.5, 0.5, 1]) @ K
    folder = write(
        tmp_path,
        "m_colorWidth = 64",
        "m_colorHeight = 48",
        "m_depthShift = 2000",
        f"m_calibrationColorIntrinsic = {words(K)} ",
        f"m_calibrationDepthIntrinsic = {words(half)}",
        name=name,
    )
    for file in list(folder.rglob("*.depth.png")):
        with Image.open(file) as image:
            small = np.asarray(image)[::2, ::2].astype(np.uint16)
        Image.fromarray(small).save(file.with_suffix(".pgm"))
        file.unlink()
    capture = open_capture(folder)
    assert len(capture.frames) == NUM and not capture.doubts
    for frame, depth in zip(capture.frames.values(), make_scene().depths, strict=False):
        np.testing.assert_allclose(frame.K, K)
        assert frame.depth_K is not None and frame.depth_size == (SIZE[0] // 2, SIZE[1] // 2)
        np.testing.assert_allclose(frame.depth_K, half)
        assert frame.cam_from_depth is None
        if frame.id == "seq-01/frame-000000":
            np.testing.assert_allclose(frame.read_depth(), depth[::2, ::2] / 2, atol=1e-6)


def test_intrinsics_of_another_size_are_scaled_and_cameras_aside_are_said(tmp_path: Path) -> None:
    aside = np.eye(4)
    aside[0, 3] = 0.025
    twice = np.diag([2, 2, 1]) @ K
    capture = open_capture(
        write(
            tmp_path,
            "m_colorWidth = 128",
            "m_colorHeight = 96",
            f"m_calibrationColorIntrinsic = {words(twice)}",
            f"m_calibrationDepthExtrinsic = {words(aside)}",
        )
    )
    scaled, taken = capture.doubts
    assert "its intrinsics are scaled" in scaled and "taken to be one" in taken
    assert capture.frames.at(0).K[0, 0] == K[0, 0] and capture.frames.at(0).depth_K is None


def test_a_text_of_another_kind_states_nothing(tmp_path: Path) -> None:
    folder = write(tmp_path)
    (folder / "info.txt").write_text("recorded on Monday")
    with pytest.raises(UserError, match="those of 7-Scenes are 640x480"):
        open_capture(folder)


def test_cameras_of_the_data_set_are_taken_with_a_warning(tmp_path: Path) -> None:
    sevenscenes(tmp_path, make_scene())
    (tmp_path / "camera-intrinsics.txt").unlink()
    for file in [*tmp_path.rglob("*.color.png"), *tmp_path.rglob("*.depth.png")]:
        if "depth" in file.name:
            file.unlink()
        else:
            Image.new("RGB", (640, 480)).save(file)
    (doubt,) = open_capture(tmp_path).doubts
    assert "fx 525" in doubt and "camera-intrinsics.txt" in doubt


@pytest.mark.parametrize(
    "lines",
    [
        (),
        ("m_calibrationColorIntrinsic = 1 2 3",),
        ("m_calibrationColorIntrinsic = a b",),
        ("m_calibrationColorIntrinsic = " + "0 " * 16,),
        (f"m_calibrationColorIntrinsic = {words(K)}", "m_depthShift = 0"),
        (f"m_calibrationColorIntrinsic = {words(K)}", "m_colorWidth = x", "m_colorHeight = 48"),
    ],
)
def test_a_broken_file_is_one_error_that_names_it(tmp_path: Path, lines: tuple[str, ...]) -> None:
    folder = write(tmp_path, *lines)
    with pytest.raises(UserError) as error:
        open_capture(folder)
    assert error.value.where == folder / "info.txt"
