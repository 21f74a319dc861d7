"""Intrinsics that a user states, and captures that are none."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from deltas_nets.captures.camera_words import Intrinsics, named_camera
from deltas_nets.captures.opening import open_capture
from deltas_nets.errors import UserError

STATED = {
    "500 510 320 240": None,
    "500,510;320,240": None,
    "500 510 320 240 .1 .2 .3 .4": ("OPENCV", (0.1, 0.2, 0.3, 0.4)),
    "500 510 320 240 .1 .2 .3 .4 .5": ("FULL_OPENCV", (0.1, 0.2, 0.3, 0.4, 0.5, 0, 0, 0)),
    "500 510 320 240 1 2 3 4 5 6 7 8": ("FULL_OPENCV", (1, 2, 3, 4, 5, 6, 7, 8)),
    "500 0 320  0 510 240  0 0 1": None,
    "500 510 320 240 0 0 0 0 0": None,
}


@pytest.mark.parametrize("text", STATED)
def test_intrinsics_in_words(text: str) -> None:
    K, lens = Intrinsics.parse(text)
    assert K.tolist() == [[500, 0, 320], [0, 510, 240], [0, 0, 1]]
    assert (lens and tuple(lens)) == STATED[text]


@pytest.mark.parametrize("text", ["", "1 2 3", "a b c d", "0 1 2 3", "nan 1 1 1", "freiburg4"])
def test_what_is_no_camera_is_refused(text: str) -> None:
    with pytest.raises(UserError) as error:
        Intrinsics.parse(text)
    assert error.value.where == "--intrinsics" and "freiburg1" in error.value.remedy


def test_cameras_are_known_by_the_names_of_recordings() -> None:
    for name in ("rgbd_dataset_freiburg1_desk", "fr1", "TUM fr1/desk", "freiburg1"):
        camera = named_camera(name)
        assert camera is not None and np.isclose(camera.K[0, 0], 517.306408)
    assert named_camera("afr1") is None and named_camera("fr12") is None


REFUSED = {
    "model.nvm": (b"NVM_V3\n", "VisualSFM", "colmap"),
    "cameras.sfm": (b"{}", "Meshroom", "COLMAP"),
    "scene.mg": (b"{}", "Meshroom", "COLMAP"),
    "cameras.xml": (b'<?xml?><document version="1"><chunk label="a">', "Metashape", "Export"),
    "poses.csv": (b"#name,x,y,alt,heading\n", "RealityCapture", "COLMAP"),
    "bundle.out": (b"# Bundle file v0.3\n", "Bundler", "colmap"),
    "sfm_data.bin": (b"", "OpenMVG", "sfm_data.json"),
    "walk.mov": (b"", "video", "ffmpeg"),
    "scan.zip": (b"PK", "archive", "unpack"),
    "scan.r3d": (b"PK", "Record3D", "EXR"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_other_programs_call_a_project_is_refused_by_name(name: str, tmp_path: Path) -> None:
    content, called, way = REFUSED[name]
    folder = tmp_path / "a folder"
    folder.mkdir()
    (folder / name).write_bytes(content)
    for path in (folder, folder / name):
        with pytest.raises(UserError) as error:
            open_capture(path)
        assert called in error.value.what and way in error.value.remedy


@pytest.mark.parametrize("inside", ["", "images"])
def test_photos_without_poses_are_told_what_finds_them(inside: str, tmp_path: Path) -> None:
    (tmp_path / inside).mkdir(exist_ok=True)
    for i in range(3):
        Image.new("RGB", (8, 8)).save(tmp_path / inside / f"{i}.jpg")
    with pytest.raises(UserError) as error:
        open_capture(tmp_path)
    assert "3 photos" in error.value.what and "colmap" in error.value.remedy


@pytest.mark.shared
@pytest.mark.parametrize("name", ["VisualSFM_example.nvm", "meshroom_example.baf"])
def test_models_of_other_programs_are_refused(name: str, shared_data: Path) -> None:
    with pytest.raises(UserError) as error:
        open_capture(shared_data / "formats" / "sceaux_models" / name)
    assert name.split("_")[0].lower() in error.value.what.lower()
