"""What is no capture yet is called by its name, and told the way to go."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from run_command import Run
from small_capture import write_capture

from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.saving import save_capture
from deltas_nets.errors import UserError

REFUSED = {
    "model.nvm": (b"NVM_V3\n", "VisualSFM", "colmap"),
    "cameras.sfm": (b"{}", "Meshroom", "COLMAP"),
    "scene.mg": (b"{}", "Meshroom", "COLMAP"),
    "cameras.xml": (b'<?xml?><document version="1"><chunk label="a">', "Metashape", "Export"),
    "block.xml": (b'<?xml?><BlocksExchange version="3.2">', "ContextCapture", "frames.json"),
    "poses.csv": (b"#name,x,y,alt,heading\n", "RealityCapture", "COLMAP"),
    "registration.csv": (b"#cameras 4\n#name,x,y,alt,yaw\n", "RealityCapture", "COLMAP"),
    "0.xmp": (b'<x xmlns:xcr="http://www.capturingreality.com/ns"/>', "RealityCapture", "COLMAP"),
    "bundle.out": (b"# Bundle file v0.3\n", "Bundler", "colmap"),
    "scan.p4d": (b"", "Pix4D", "colmap"),
    "sfm_data.bin": (b"", "OpenMVG", "sfm_data.json"),
    "walk.mov": (b"", "video", "ffmpeg"),
    "scan.zip": (b"PK", "archive", "unpack"),
    "scan.r3d": (b"PK", "Record3D", "EXR"),
    "run.bag": (b"#ROSBAG", "ROS", "frames.json"),
    "run.mcap": (b"", "ROS", "frames.json"),
    "walk.svo": (b"", "ZED", "frames.json"),
    "scan.glb": (b"", "mesh", "photos"),
    "IMG_1.HEIC": (b"", "photo", "poses"),
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


def _photos(folder: Path, number: int = 3) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(number):
        Image.new("RGB", (8, 8)).save(folder / f"{i}.jpg")


LAYOUTS = {
    "EuRoC": ("mav0/cam0/data.csv",),
    "KITTI": ("calib.txt", "times.txt", "image_2/0.png"),
    "NICE-SLAM": ("traj.txt", "results/frame0.jpg"),
    "Stray Scanner": ("odometry.csv", "camera_matrix.csv", "rgb.mp4"),
    "deltas depth": ("summary.json", "depth/0.png"),
    "NeuS": ("cameras_sphere.npz", "image/0.png"),
    "SDFStudio": ("meta_data.json",),
    "NSVF": ("rgb/0_0.png", "pose/0_0.txt", "intrinsics.txt", "bbox.txt"),
    "NeRF++": ("rgb/0.png", "pose/0.txt", "intrinsics/0.txt"),
    "RTAB-Map": ("walk_rgb/0.jpg", "walk_depth/0.png", "walk_calib/0.yaml", "walk_poses.txt"),
    "Record3D": ("metadata", "rgbd/0.jpg"),
    "MicMac": ("Ori-Calib/Orientation-0.jpg.xml",),
    "MVSNet": ("Cameras/pair.txt", "Rectified/scan1/0.png"),
    "TUM": ("associations.txt", "rgb/0.png"),
    "COLMAP": ("database.db",),
}


@pytest.mark.parametrize("called", LAYOUTS)
def test_layouts_that_are_not_read_are_refused_by_name(called: str, tmp_path: Path) -> None:
    _photos(tmp_path)
    for name in LAYOUTS[called]:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    with pytest.raises(UserError) as error:
        open_capture(tmp_path)
    assert called in error.value.what and error.value.where == tmp_path


def test_a_model_in_a_folder_of_the_photos_is_named(tmp_path: Path) -> None:
    _photos(tmp_path / "photos")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "bundle.out").write_bytes(b"# Bundle file v0.3\n")
    with pytest.raises(UserError) as error:
        open_capture(tmp_path)
    assert "Bundler" in error.value.what and error.value.where == tmp_path / "out" / "bundle.out"


@pytest.mark.parametrize("inside", ["", "images", "2024/may/raw"])
def test_photos_without_poses_are_told_what_finds_them(inside: str, tmp_path: Path) -> None:
    _photos(tmp_path / inside)
    # Windows and macOS leave these behind; depth is no photo.
    (tmp_path / inside / "Thumbs.db").write_bytes(b"")
    (tmp_path / inside / "._0.jpg").write_bytes(b"\0\5\x16\7")
    _photos(tmp_path / "depth", 5)
    with pytest.raises(UserError) as error:
        open_capture(tmp_path)
    assert "3 photos" in error.value.what and "colmap" in error.value.remedy
    assert error.value.where == tmp_path / inside and "frames.json" in error.value.remedy


def test_folders_called_after_depth_are_the_last_for_photos(tmp_path: Path) -> None:
    _photos(tmp_path / "a_depth", 5)
    _photos(tmp_path / "a_rgb")
    for folder, number in (("a_rgb", 3), ("a_depth", 5)):
        with pytest.raises(UserError, match=f"{number} photos") as error:
            open_capture(tmp_path)
        assert error.value.where == tmp_path / folder
        shutil.rmtree(tmp_path / folder)


@pytest.mark.parametrize(
    ("name", "meant"),
    [("Frames.json", "frames.json"), ("transform.json", "transforms.json")],
)
def test_a_file_that_is_nearly_called_as_known_is_named(
    tmp_path: Path, name: str, meant: str
) -> None:
    _photos(tmp_path)
    (tmp_path / name).write_text("{}")
    for path in (tmp_path, tmp_path / name):
        with pytest.raises(UserError) as error:
            open_capture(path)
        assert error.value.where == tmp_path / name and f"rename it {meant}" in error.value.remedy


@pytest.mark.parametrize("to", ["own", "colmap", "colmap elsewhere", "transforms", "scannet"])
def test_who_names_the_photos_of_a_capture_is_told_the_capture(to: str, tmp_path: Path) -> None:
    capture = tmp_path / "captures" / "capture"
    save_capture(open_capture(write_capture(tmp_path / "in")), capture, to.split()[0])
    if "elsewhere" in to:
        (capture / "sparse").rename(capture / "model")
    # Beside others, one of them known by a file two folders down.
    (tmp_path / "captures" / "opensfm").mkdir()
    (tmp_path / "captures" / "opensfm" / "reconstruction.json").write_text("[]")
    photo = next(capture.rglob("*.jpg"))
    for path in (photo.parent, photo):
        with pytest.raises(UserError) as error:
            open_capture(path)
        assert "part of a capture" in error.value.what
        assert error.value.remedy == f"name {capture}"


KINDS = {
    "0.heic": (b"\0\0\0\x18ftypheic", "convert it to JPEG"),
    "0.dng": (b"II*\0", "convert it to JPEG"),
    "0.jpg": (b"<html>not found</html>", "damaged"),
    "0.png": (b"", "empty"),
}


@pytest.mark.parametrize("name", KINDS)
def test_a_capture_of_images_that_are_none_says_why(name: str, tmp_path: Path) -> None:
    capture = tmp_path / "capture"
    save_capture(open_capture(write_capture(tmp_path / "in")), capture, "own")
    content, why = KINDS[name]
    for image in list((capture / "images").iterdir()):
        image.with_suffix(Path(name).suffix).write_bytes(content)
        if image.suffix != Path(name).suffix:
            image.unlink()
    text = (capture / "frames.json").read_text()
    (capture / "frames.json").write_text(text.replace(".jpg", Path(name).suffix))
    with pytest.raises(UserError) as error:
        open_capture(capture)
    assert "none of the 4 images" in error.value.what and why in error.value.what


def test_one_image_that_is_read_is_enough_to_open_a_capture(tmp_path: Path) -> None:
    capture = write_capture(tmp_path)
    for i in range(3):
        (capture / "color" / f"{i}.jpg").write_bytes(b"")
    assert len(open_capture(capture).frames) == 4


def test_images_of_16_bits_are_the_finding_of_the_check(tmp_path: Path, run: Run) -> None:
    capture = write_capture(tmp_path)
    for i in range(4):
        grey = np.full((48, 64), 1000 * i, np.uint16)
        Image.fromarray(grey).save(capture / "color" / f"{i}.png")
        (capture / "color" / f"{i}.jpg").unlink()
    result = run("check", capture)
    assert result.code == 1
    assert "images cannot be used" in result.out and "8-bit" in result.out


@pytest.mark.shared
@pytest.mark.parametrize("name", ["VisualSFM_example.nvm", "meshroom_example.baf"])
def test_models_of_other_programs_are_refused(name: str, shared_data: Path) -> None:
    with pytest.raises(UserError) as error:
        open_capture(shared_data / "formats" / "sceaux_models" / name)
    assert name.split("_")[0].lower() in error.value.what.lower()
