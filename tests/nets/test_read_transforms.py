"""transforms.json: all names that nerfstudio and instant-ngp have for a camera, and what breaks."""

import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from PIL import Image
from posed_captures import image_of, rigid

from deltas_geom import PosedViews
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import FloatArray, Lens
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.saving import save_capture
from deltas_nets.errors import UserError

EYE = np.eye(4).tolist()
CAMERA = {"fl_x": 9.0, "fl_y": 9.5, "cx": 4.0, "cy": 3.0, "w": 8, "h": 6}


def write(
    folder: Path, *frames: dict[str, Any], name: str = "transforms.json", **root: Any
) -> Path:
    """The file and two images, images/a.png and images/b.png."""
    (folder / "images").mkdir(exist_ok=True)
    for image in ("a.png", "b.png"):
        shutil.copy(image_of((6, 8)), folder / "images" / image)
    said = [{"file_path": "images/a.png", "transform_matrix": EYE, **frame} for frame in frames]
    (folder / name).write_text(json.dumps({**(CAMERA | root), "frames": said or [_frame("a")]}))
    return folder


def _frame(name: str) -> dict[str, Any]:
    return {"file_path": f"images/{name}.png", "transform_matrix": EYE}


def the_frame(capture: Capture) -> Any:
    return next(iter(capture.frames.values()))


@given(world_from_cam=rigid())
def test_axes_are_opengls(
    tmp_path_factory: pytest.TempPathFactory, world_from_cam: FloatArray
) -> None:
    folder = tmp_path_factory.mktemp("it")
    write(folder, {"transform_matrix": world_from_cam.tolist()}, _frame("b"))
    views = PosedViews.from_opengl(torch.eye(3)[None].double(), torch.tensor(world_from_cam)[None])
    read = open_capture(folder).frame("a").cam_from_world
    np.testing.assert_allclose(read, views.cam_from_world[0].numpy(), atol=1e-9)


def test_the_first_pixels_centre_is_half_a_pixel_from_the_corner(tmp_path: Path) -> None:
    K = the_frame(open_capture(write(tmp_path))).K
    assert K.tolist() == [[9, 0, 3.5], [0, 9.5, 2.5], [0, 0, 1]]


@pytest.mark.parametrize(
    ("root", "frame", "focal"),
    [
        ({}, {}, (9, 9.5)),
        ({}, {"fl_x": 7.0, "fl_y": 7.5}, (7, 7.5)),
        ({"fl_y": None}, {}, (9, 9)),
        ({"fl_x": None, "fl_y": None, "camera_angle_x": math.pi / 2}, {}, (4, 4)),
        ({"fl_x": None, "camera_angle_x": math.pi / 2, "camera_angle_y": math.pi / 2}, {}, (4, 3)),
        ({}, {"camera_angle_x": math.pi / 2}, (4, 4)),
    ],
)
def test_focal_lengths_and_angles_of_root_and_frame(
    tmp_path: Path, root: dict[str, Any], frame: dict[str, Any], focal: tuple[float, float]
) -> None:
    K = the_frame(open_capture(write(tmp_path, frame, **root))).K
    assert (K[0, 0], K[1, 1]) == pytest.approx(focal)


@pytest.mark.parametrize(
    ("said", "lens"),
    [
        ({}, None),
        ({"camera_model": "PINHOLE"}, None),
        ({"camera_model": "OPENCV", "k1": 0.0, "k2": 0.0}, None),
        ({"k1": 0.1}, Lens("OPENCV", (0.1, 0, 0, 0))),
        ({"k1": 0.1, "k2": 0.2, "p1": 0.3, "p2": 0.4}, Lens("OPENCV", (0.1, 0.2, 0.3, 0.4))),
        ({"k3": 0.1, "p2": 0.2}, Lens("FULL_OPENCV", (0, 0, 0, 0.2, 0.1, 0, 0, 0))),
        ({"camera_model": "OPENCV_FISHEYE", "k4": 0.1}, Lens("OPENCV_FISHEYE", (0, 0, 0, 0.1))),
        ({"is_fisheye": True, "k1": 0.1}, Lens("OPENCV_FISHEYE", (0.1, 0, 0, 0))),
        ({"camera_model": "EQUIRECTANGULAR"}, Lens("EQUIRECTANGULAR", ())),
        ({"camera_model": "opencv_fisheye"}, Lens("OPENCV_FISHEYE", (0, 0, 0, 0))),
        ({"camera_model": "OpenCV Fisheye"}, Lens("OPENCV_FISHEYE", (0, 0, 0, 0))),
        ({"camera_model": "fisheye", "k1": 0.1}, Lens("OPENCV_FISHEYE", (0.1, 0, 0, 0))),
        ({"camera_model": "perspective"}, None),
        ({"camera_model": "Pinhole"}, None),
        ({"camera_model": "", "k1": 0.1}, Lens("OPENCV", (0.1, 0, 0, 0))),
        ({"camera_model": "", "is_fisheye": True}, Lens("OPENCV_FISHEYE", (0, 0, 0, 0))),
        (
            {"distortion_params": [0.1, 0.2, 0, 0, 0.3, 0.4], "k1": 9.0},
            Lens("OPENCV", (0.1, 0.2, 0.3, 0.4)),
        ),
    ],
)
def test_lenses(tmp_path: Path, said: dict[str, Any], lens: Lens | None) -> None:
    assert the_frame(open_capture(write(tmp_path, **said))).lens == lens


def test_distortion_of_a_frame_goes_before_that_of_the_root(tmp_path: Path) -> None:
    listed = {"distortion_params": [0.1, 0, 0, 0, 0, 0]}
    assert the_frame(open_capture(write(tmp_path, listed, k1=0.2))).lens.coefficients[0] == 0.1
    with pytest.raises(UserError, match="distortion_params of 4 numbers"):
        open_capture(write(tmp_path, distortion_params=[0.1, 0, 0, 0]))


@pytest.mark.parametrize(
    "name",
    [
        "./images/a.png",
        "images/a",
        r"images\a.png",
        r"C:\scans\it\images\a.png",
        "/home/someone/it/images/a.png",
        "elsewhere/a.png",
        "../images/a.png",
        "images/A.PNG",
    ],
)
def test_images_are_found_by_the_last_parts_of_their_names(tmp_path: Path, name: str) -> None:
    capture = open_capture(write(tmp_path, {"file_path": name}))
    assert the_frame(capture).image_path.samefile(tmp_path / "images" / "a.png")
    assert [id.split("/")[-1].lower() for id in capture.frames] == ["a"]


def test_images_beside_the_folder_are_found_where_the_file_says_so(tmp_path: Path) -> None:
    (tmp_path / "it").mkdir()
    shutil.move(write(tmp_path) / "transforms.json", tmp_path / "it")
    text = (tmp_path / "it" / "transforms.json").read_text()
    (tmp_path / "it" / "transforms.json").write_text(text.replace("images/a", "../images/a"))
    assert list(open_capture(tmp_path / "it").frames) == ["a"]


def test_an_image_of_another_suffix_is_taken_with_a_warning(tmp_path: Path) -> None:
    names = ["images/a.jpg", "images/b.JPEG", "elsewhere/a.jpg"]
    capture = open_capture(write(tmp_path, *({"file_path": name} for name in names)))
    assert list(capture.frames) == ["images/a", "images/b"]
    assert list(capture.lost) == ["elsewhere/a"]
    (doubt,) = capture.doubts
    assert doubt.startswith(f"{tmp_path}/images/a.png is taken for images/a.jpg")
    shutil.copy(tmp_path / "images" / "a.png", tmp_path / "images" / "a.webp")
    assert "images/a" in open_capture(tmp_path).lost  # no telling which


def test_of_reduced_copies_alone_the_largest_is_taken_with_a_warning(tmp_path: Path) -> None:
    write(tmp_path)
    for factor in (2, 4):
        (tmp_path / f"images_{factor}").mkdir()
        for name in ("a.png", "b.png"):
            with Image.open(tmp_path / "images" / name) as image:
                reduced = image.resize((8 // factor, 6 // factor))
            reduced.save(tmp_path / f"images_{factor}" / name)
    shutil.rmtree(tmp_path / "images")
    capture = open_capture(tmp_path)
    assert the_frame(capture).image_path == tmp_path / "images_2" / "a.png"
    assert the_frame(capture).K[0, 0] == CAMERA["fl_x"] / 2
    assert [("is taken for" in d, "are scaled" in d) for d in capture.doubts] == [
        (True, False),
        (False, True),
    ]


@pytest.mark.parametrize("name", ["/data/c.png", "C:/data/c.png", "../../images/c.png"])
def test_who_names_images_outside_is_told_to_copy_or_link_them(tmp_path: Path, name: str) -> None:
    with pytest.raises(UserError) as error:
        open_capture(write(tmp_path, {"file_path": name}))
    assert "copy or link" in error.value.remedy and "not followed" in error.value.remedy


def test_names_that_fit_two_images_fit_none(tmp_path: Path) -> None:
    for name in ("left", "right"):
        (tmp_path / name).mkdir()
        shutil.copy(image_of((6, 8)), tmp_path / name / "c.png")
    capture = open_capture(write(tmp_path, _frame("a"), {"file_path": "c"}))
    assert [lost.reason for lost in capture.lost.values()] == ["no image"]


def test_a_stated_size_other_than_the_files_scales_intrinsics(tmp_path: Path) -> None:
    folder = write(tmp_path, w=16, h=12, cx=8, cy=6, fl_x=18)
    capture = open_capture(folder)
    assert the_frame(capture).K[0].tolist() == [9, 0, 3.5]
    assert len(capture.doubts) == 1
    write(tmp_path, w=6, h=8)
    with pytest.raises(UserError) as error:
        open_capture(folder)
    assert error.value.where == tmp_path / "images" / "a.png"


def test_depth_its_unit_and_what_it_says_of_the_world(tmp_path: Path) -> None:
    steps = np.full((6, 8), 250, np.uint16)
    (tmp_path / "depth").mkdir()
    Image.fromarray(steps).save(tmp_path / "depth" / "a.png")
    depth = {"depth_file_path": "depth/a.png"}
    capture = open_capture(write(tmp_path, depth, applied_scale=2.0))
    assert capture.metric and the_frame(capture).read_depth()[0, 0] == pytest.approx(0.25)
    capture = open_capture(write(tmp_path, depth, depth_unit_scale_factor=0.01))
    assert the_frame(capture).read_depth()[0, 0] == pytest.approx(2.5)
    np.save(tmp_path / "depth" / "b.npy", np.full((6, 8), 250.5, np.float32))
    floats = {"depth_file_path": "depth/b.npy"}  # which nerfstudio multiplies, too
    for root, metres in (({}, 0.2505), ({"depth_unit_scale_factor": 1}, 250.5)):
        capture = open_capture(write(tmp_path, floats, **root))
        assert the_frame(capture).read_depth()[0, 0] == pytest.approx(metres)
        for format in ("own", "transforms"):
            saved = tmp_path / f"{format}-{metres}"
            save_capture(capture, saved, format)
            found = the_frame(open_capture(saved))
            assert found.read_depth()[0, 0] == pytest.approx(metres)
            assert found.depth_path is not None and found.depth_path.suffix == ".npy"
    both = [_frame("a") | depth, _frame("b") | floats]
    save_capture(open_capture(write(tmp_path, *both)), tmp_path / "both", "transforms")
    first, second = open_capture(tmp_path / "both").frames.values()
    assert first.read_depth()[0, 0] == pytest.approx(0.25)
    assert second.read_depth()[0, 0] == pytest.approx(0.2505, abs=6e-4)
    assert not open_capture(write(tmp_path)).metric
    gone = [_frame("a") | depth, _frame("b") | {"depth_file_path": "gone/b.png"}]
    capture = open_capture(write(tmp_path, *gone))
    assert "the depth gone/b.png is missing" in " ".join(capture.doubts)
    capture = open_capture(write(tmp_path, gone[1]))
    assert capture.metric and len(capture.doubts) == 1
    assert open_capture(write(tmp_path, units="metres")).metric


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_points_and_poses_come_back_to_the_worlds_own_size(tmp_path: Path, form: str) -> None:
    pose = np.eye(4)
    pose[0, 3] = 3
    head = f"ply\nformat {form} 1.0\nelement vertex 2\nproperty float x\nproperty float y\n"
    head += "property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n"
    order = ">" if "big" in form else "<"
    kind = np.dtype([("xyz", f"{order}f4", 3), ("rgb", "u1", 3)])
    table = np.array([((1, 2, 3), (4, 5, 6)), ((np.nan, 0, 0), (0, 0, 0))], kind)
    body = b"1 2 3 4 5 6\nnan 0 0 0 0 0\n" if form == "ascii" else table.tobytes()
    (tmp_path / "points.ply").write_bytes(f"{head}end_header\n".encode() + body)
    frame = {"transform_matrix": pose.tolist()}
    capture = open_capture(write(tmp_path, frame, applied_scale=0.5, ply_file_path="points.ply"))
    assert the_frame(capture).cam_from_world[0, 3] == -6
    assert capture.points is not None
    assert capture.points.xyz.tolist() == [[2, 4, 6]]
    assert capture.points.rgb.tolist() == [[4, 5, 6]]
    (doubt,) = open_capture(write(tmp_path, ply_file_path="gone.ply")).doubts
    assert "gone.ply is missing" in doubt


def test_synthetic_scenes_have_three_files(tmp_path: Path) -> None:
    for part in ("train", "test"):
        (tmp_path / part).mkdir()
        shutil.copy(image_of((6, 8)), tmp_path / part / "r_0.png")
        write(tmp_path, {"file_path": f"./{part}/r_0"}, name=f"transforms_{part}.json")
    assert list(open_capture(tmp_path).frames) == ["test/r_0", "train/r_0"]
    assert list(open_capture(tmp_path / "transforms_test.json").frames) == ["test/r_0"]


def test_a_lost_pose_and_a_missing_image_are_lost_frames(tmp_path: Path) -> None:
    nan = np.full((4, 4), np.nan).tolist()
    for pose in (nan, None):
        capture = open_capture(
            write(tmp_path, _frame("a"), _frame("b") | {"transform_matrix": pose}, _frame("c"))
        )
        assert len(capture.lost) == 2
    with pytest.raises(UserError, match=r"frame 1 \(images/b.png\) has no transform_matrix"):
        capture.frame("b")
    with pytest.raises(UserError, match="has no transform_matrix") as error:
        open_capture(write(tmp_path, {"transform_matrix": None}))
    assert error.value.where == tmp_path / "transforms.json"
    assert {id: lost.reason for id, lost in capture.lost.items()} == {
        "b": "no pose",
        "c": "no image",
    }


@pytest.mark.parametrize(
    ("root", "frame"),
    [
        ({"fl_x": 0}, {}),
        ({"fl_x": "9"}, {}),
        ({"fl_x": True}, {}),
        ({"fl_x": None}, {}),
        ({"fl_x": 10**400}, {}),
        ({"fl_x": None, "camera_angle_x": 4}, {}),
        ({"cx": math.inf}, {}),
        ({"w": 0}, {}),
        ({"w": 8.5}, {}),
        ({"camera_model": "CUBIC"}, {}),
        ({"camera_model": 3}, {}),
        ({"k4": 0.1}, {}),
        ({"applied_scale": 0}, {}),
        ({"frames": []}, {}),
        ({"frames": {}}, {}),
        ({"frames": [3]}, {}),
        ({}, {"file_path": ""}),
        ({}, {"file_path": ".."}),
        ({}, {"file_path": None}),
        ({}, {"file_path": "a\0.png"}),
        ({}, {"transform_matrix": None}),
        ({}, {"transform_matrix": [[1, 0, 0, 0]] * 2}),
        ({}, {"transform_matrix": [[1, 0, 0, "0"]] * 4}),
        ({}, {"transform_matrix": (2 * np.eye(4)).tolist()}),
        ({}, {"transform_matrix": np.diag([1.0, 1, -1, 1]).tolist()}),
    ],
)
def test_nonsense_is_one_error_that_names_the_file(
    tmp_path: Path, root: dict[str, Any], frame: dict[str, Any]
) -> None:
    folder = write(tmp_path, frame)
    said = json.loads((folder / "transforms.json").read_text())
    (folder / "transforms.json").write_text(json.dumps(said | root))
    with pytest.raises(UserError) as error:
        open_capture(folder)
    assert error.value.where == folder / "transforms.json"


@pytest.mark.parametrize(
    ("root", "frame", "what"),
    [
        ({"fl_x": "9"}, {}, "the file has a fl_x"),
        ({"w": 0}, {}, "the file has a size"),
        ({}, {"fl_x": "9"}, "frame 0 (images/a.png) has a fl_x"),
        ({"cx": "4"}, {"fl_x": 9}, "the file has a cx"),
        ({"fl_x": None}, {}, "the file has no focal length"),
        ({"fl_x": None}, {"K": [[9, 0, 4], [0, 9, 3], [0, 0, 1]]}, "but K; write fl_x"),
        ({"fl_x": None, "camera_angle_x": 57.17}, {}, "57.17, not between 0 and pi (degrees? say"),
    ],
)
def test_what_is_wrong_is_said_where_it_stands(
    tmp_path: Path, root: dict[str, Any], frame: dict[str, Any], what: str
) -> None:
    with pytest.raises(UserError) as error:
        open_capture(write(tmp_path, frame, **root))
    assert what in error.value.what


def test_an_empty_file_is_said_to_be_empty(tmp_path: Path) -> None:
    (tmp_path / "transforms.json").write_bytes(b"\n")
    with pytest.raises(UserError, match="is empty"):
        open_capture(tmp_path)


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b"[]", b"\xff\xfe", b"[" * 10**6, b'{"frames": 1, "frames": 2}', b"1" * 10**5],
)
def test_a_file_that_is_no_json_is_one_error(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "transforms.json").write_bytes(content)
    with pytest.raises(UserError) as error:
        open_capture(tmp_path)
    assert error.value.where == tmp_path / "transforms.json"
