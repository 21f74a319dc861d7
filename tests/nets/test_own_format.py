"""Our own format: what docs/captures.md promises, and one line of error for everything else."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from posed_captures import image_of

from deltas_nets.captures.frame import Lens
from deltas_nets.captures.opening import open_capture
from deltas_nets.errors import UserError

EYE = np.eye(4)
AHEAD = EYE.copy()
AHEAD[2, 3] = 2.0
"""2 m along z."""
CAMERA = {"fx": 9.0, "fy": 9.5, "cx": 3.5, "cy": 2.5}
FRAMES = [
    {"image": "images/a.png", "world_from_cam": AHEAD.tolist()},
    {"image": "images/cam1/b.png", "cam_from_world": AHEAD.tolist()},
]


def write(folder: Path, frames: Any = None, **root: Any) -> Path:
    for name in ("a", "cam1/b"):
        (folder / "images" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(image_of((6, 8)), folder / "images" / f"{name}.png")
    said = {
        "version": 1,
        "units": "metres",
        **CAMERA,
        "frames": FRAMES if frames is None else frames,
    }
    (folder / "frames.json").write_text(json.dumps(said | root))
    return folder


def changed(**values: Any) -> list[dict[str, Any]]:
    """The first frame, otherwise."""
    return [FRAMES[0] | values]


def test_the_shortest_file(tmp_path: Path) -> None:
    capture = open_capture(write(tmp_path))
    assert list(capture.frames) == ["a", "cam1/b"]
    first, second = capture.frames.values()
    assert first.K.tolist() == [[9, 0, 3.5], [0, 9.5, 2.5], [0, 0, 1]]
    assert (first.cam_from_world[2, 3], second.cam_from_world[2, 3]) == (-2, 2)
    assert capture.metric and capture.points is None and capture.depth_ranges is None
    assert not open_capture(write(tmp_path, units="unknown")).metric


def test_the_page_that_describes_it_is_right(tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "docs" / "captures.md").read_text(encoding="utf-8")
    blocks = dict(
        re.findall(r"^```(json|python)\n(.*?)^```$", text, flags=re.DOTALL | re.MULTILINE)
    )
    table = re.search(r"^```\n(# units.*?)^```$", text, flags=re.DOTALL | re.MULTILINE)
    assert table is not None
    for name in ("0.jpg", "1.jpg"):
        (tmp_path / "images").mkdir(exist_ok=True)
        shutil.copy(image_of((480, 640)), tmp_path / "images" / name)
    (tmp_path / "frames.json").write_text(blocks["json"])
    first = open_capture(tmp_path)
    (tmp_path / "frames.json").rename(tmp_path / "old.json")
    (tmp_path / "frames.csv").write_text(table[1])
    second = open_capture(tmp_path)
    names: dict[str, Any] = {}
    exec(blocks["python"], names)
    poses = np.linalg.inv(first.frames.cam_from_world)
    names["write_frames"](tmp_path, ["images/0.jpg", "images/1.jpg"], poses, first.frames.K[0])
    (tmp_path / "frames.csv").unlink()
    assert first.fingerprint() == second.fingerprint() == open_capture(tmp_path).fingerprint()


def test_the_file_itself_may_be_named(tmp_path: Path) -> None:
    assert len(open_capture(write(tmp_path) / "frames.json").frames) == 2


@pytest.mark.parametrize(
    "pose", [AHEAD.tolist(), AHEAD[:3].tolist(), AHEAD.ravel().tolist(), AHEAD[:3].ravel().tolist()]
)
def test_poses_are_matrices_or_their_numbers(tmp_path: Path, pose: Any) -> None:
    frame = open_capture(write(tmp_path, changed(world_from_cam=pose))).frame("a")
    assert frame.cam_from_world[:, 3].tolist() == [0, 0, -2, 1]


def test_a_csv_says_the_same(tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / "frames.json").unlink()
    pose = " ".join(f"{number:g}" for number in AHEAD.ravel())
    (tmp_path / "frames.csv").write_text(
        "# units: metres\n# pixel_centres: halves\n# depth_range: 0.5 4\n"
        "id,image,fx,fy,cx,cy,lens,coefficients,world_from_cam,sources\n"
        f'x y,images/a.png,9,9.5,4,3,SIMPLE_RADIAL,0.1,{pose},7\n7,"cam1/b.png",9,9,4,3,,,{pose},\n'
    )
    capture = open_capture(tmp_path)
    assert list(capture.frames) == ["7", "x y"]
    assert capture.frame("x y").lens == Lens("SIMPLE_RADIAL", (0.1,))
    assert capture.frame("x y").K.tolist() == [[9, 0, 3.5], [0, 9.5, 2.5], [0, 0, 1]]
    assert capture.frame(7).cam_from_world[2, 3] == -2
    assert capture.sources == {"x y": ("7",)}
    assert capture.depth_ranges is not None
    assert capture.depth_ranges.tolist() == [[0.5, 4], [0.5, 4]]


def test_frames_name_cameras_and_say_more_than_they(tmp_path: Path) -> None:
    cameras = {"left": {"fx": 5.0, "lens": "OPENCV", "coefficients": [0.1, 0, 0, 0]}}
    capture = open_capture(write(tmp_path, changed(camera="left", fy=6.0), cameras=cameras))
    assert capture.frame("a").K.tolist() == [[5, 0, 3.5], [0, 6, 2.5], [0, 0, 1]]
    assert capture.frame("a").lens == Lens("OPENCV", (0.1, 0, 0, 0))


def test_depth_points_and_who_sees_them(tmp_path: Path) -> None:
    (tmp_path / "depth").mkdir()
    Image.fromarray(np.full((3, 4), 500, np.uint16)).save(tmp_path / "depth" / "a.png")
    (tmp_path / "points.csv").write_text("x,y,z\n1,2,3\n4,5,6\n")
    (tmp_path / "observations.csv").write_text("point,frame,x,y\n1,0,3.5,2.5\n0,1,0.5,0.5\n")
    camera = {"fx": 4, "fy": 4, "cx": 2, "cy": 1.5, "width": 4, "height": 3}
    capture = open_capture(
        write(
            tmp_path,
            [FRAMES[0] | {"depth": "depth/a.png"}, FRAMES[1]],
            depth_scale=5000,
            depth_camera=camera,
            pixel_centres="halves",
            points="points.csv",
            observations="observations.csv",
        )
    )
    frame = capture.frame("a")
    assert frame.read_depth()[0, 0] == pytest.approx(0.1)
    assert frame.depth_K is not None and frame.depth_K[0].tolist() == [4, 0, 1.5]
    assert capture.frame("cam1/b").depth_path is None
    assert capture.points is not None
    assert capture.points.xyz.tolist() == [[1, 2, 3], [4, 5, 6]]
    seen = capture.points.seen
    assert (seen.point.tolist(), seen.frame.tolist()) == ([1, 0], [0, 1])
    assert seen.pixels.tolist() == [[3, 2], [0, 0]]


@pytest.mark.parametrize("key", ["quaternion", "rotation", "R", "t", "position", "qw"])
def test_a_part_of_a_pose_is_told_to_be_of_a_matrix(tmp_path: Path, key: str) -> None:
    for frames in (changed(**{key: [1, 0, 0, 0]}), [{**FRAMES[0], key: 1}, FRAMES[1]]):
        with pytest.raises(UserError, match="unknown key") as error:
            open_capture(write(tmp_path, frames))
        assert "world_from_cam, a 4x4" in error.value.remedy
    with pytest.raises(UserError, match="has more than 240 bytes"):
        open_capture(write(tmp_path, changed(id="é" * 121)))


@pytest.mark.parametrize(
    ("key", "meant"),
    [
        *[("worldfromcam", "world_from_cam"), ("Image", "image"), ("depht", "depth")],
        *[("lense", "lens"), ("file", "image"), ("K", "fx, fy, cx, cy"), ("w2c", "cam_from_world")],
    ],
)
def test_an_unknown_key_is_named_with_the_one_that_was_meant(
    tmp_path: Path, key: str, meant: str
) -> None:
    with pytest.raises(UserError) as error:
        open_capture(write(tmp_path, changed(**{key: 1})))
    assert key in error.value.what and error.value.remedy == f"did you mean {meant}?"


def test_a_unit_of_known_length_is_read_as_metres_or_refused_by_name(tmp_path: Path) -> None:
    assert all(open_capture(write(tmp_path, units=u)).metric for u in ("m", "Meters", "metre"))
    for units, factor in {"mm": "0.001", "Centimeters": "0.01", "inches": "0.0254"}.items():
        with pytest.raises(UserError) as error:
            open_capture(write(tmp_path, units=units))
        assert units in error.value.what and f"--scale {factor}" in error.value.remedy


@pytest.mark.parametrize("reason", ["no pose", "no image"])
def test_frames_without_pose_or_image_are_lost(tmp_path: Path, reason: str) -> None:
    lost = {
        "no pose": {"world_from_cam": np.full((4, 4), np.nan).tolist()},
        "no image": {"image": "images/gone.png"},
    }[reason]
    frames = [FRAMES[0] | lost | {"id": 3}, FRAMES[1] | {"sources": ["3"]}]
    capture = open_capture(write(tmp_path, frames))
    assert {id: each.reason for id, each in capture.lost.items()} == {"3": reason}
    assert capture.sources is None


@pytest.mark.parametrize(
    "root",
    [
        {"units": None},
        {"units": 3},
        {"version": 2},
        {"version": "1"},
        {"frames": []},
        {"frames": [1]},
        {"unit": "metres"},
        {"fx": None},
        {"fx": -1},
        {"cx": "4"},
        {"width": 8},
        {"pixel_centres": "corners"},
        {"lens": "OPENCV"},
        {"lens": "OPENCVV", "coefficients": [0, 0, 0, 0]},
        {"coefficients": [0.1]},
        {"cameras": {"left": {"focal": 3}}},
        {"cameras": 3},
        {"depth_range": [4, 1]},
        {"points": "gone.csv"},
        {"frames": changed(camera="lft")},
        {"frames": [*changed(depth_range=[0.5, 4]), FRAMES[1]]},
        {"frames": changed(world_from_cam=[1, 2, 3])},
        {"frames": changed(world_from_cam=(2 * EYE).tolist())},
        {"frames": changed(cam_from_world=EYE.tolist())},
        {"frames": changed(image="")},
        {"frames": changed(image=3)},
        {"frames": changed(id="../x")},
        {"frames": changed(id="x" * 300)},
        {"frames": changed(id="a\0")},
        {"frames": changed(sources=["b"])},
        {"frames": changed(sources="b")},
        {"frames": [FRAMES[0], FRAMES[0]]},
    ],
)
def test_nonsense_is_one_error_that_names_the_file(tmp_path: Path, root: dict[str, Any]) -> None:
    with pytest.raises(UserError) as error:
        open_capture(write(tmp_path, **root))
    assert error.value.where == tmp_path / "frames.json"


@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("points.csv", "1,2\n"),
        ("points.csv", "a,b,c\n"),
        ("points.csv", "1,2,nan\n"),
        ("points.csv", b"\xff\xfe"),
        ("observations.csv", "0,0,1\n"),
        ("observations.csv", "2,0,1,1\n"),
        ("observations.csv", "0,2,1,1\n"),
        ("observations.csv", "0.5,0,1,1\n"),
        ("observations.csv", "0,0,nan,1\n"),
    ],
)
def test_broken_tables_are_one_error(tmp_path: Path, file: str, content: str | bytes) -> None:
    (tmp_path / "points.csv").write_text("1,2,3\n")
    (tmp_path / "observations.csv").write_text("0,0,1,1\n")
    (tmp_path / file).write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(UserError):
        open_capture(write(tmp_path, points="points.csv", observations="observations.csv"))


def test_a_csv_of_a_spreadsheet_with_decimal_commas_says_the_same(tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / "frames.json").unlink()
    pose = " ".join(f"{number:g}" for number in (AHEAD + 0.5 * np.eye(4, k=3)).ravel())
    text = (
        f"# fx: 9.25\n# units: metres\nid,image,fy,cx,cy,world_from_cam\n7,b.png,9.5,4,3,{pose}\n"
    )
    first, second = tmp_path / "points", tmp_path / "commas"
    for folder, said in ((first, text), (second, text.replace(",", ";").replace(".5", ",5"))):
        folder.mkdir()
        (folder / "frames.csv").write_text(
            said.replace("9.25", "9,25" if folder == second else "9.25")
        )
        shutil.copy(tmp_path / "images" / "cam1" / "b.png", folder)
    assert open_capture(first).fingerprint() == open_capture(second).fingerprint()
    assert open_capture(second).frame("7").cam_from_world[0, 3] == -0.5


@pytest.mark.parametrize("form", ["sep=;", "tabs", "filled"])
def test_a_csv_of_a_spreadsheet_says_the_same(tmp_path: Path, form: str) -> None:
    write(tmp_path)
    (tmp_path / "frames.json").unlink()
    pose = " ".join(f"{number:g}" for number in AHEAD.ravel())
    text = "# units: metres\nimage,fx,fy,cx,cy,world_from_cam\n"
    text += f"images/a.png,9,9.5,3.5,2.5,{pose}\n"
    (tmp_path / "frames.csv").write_text(text)
    expected = open_capture(tmp_path).fingerprint()
    other = {
        "sep=;": "sep=;\n" + text.replace(",", ";").replace(".5", ",5"),
        "tabs": text.replace(",", "\t"),
        "filled": text.replace("metres", "metres,,,,,") + ",,,,,\n , ,,,,\n",
    }[form]
    (tmp_path / "frames.csv").write_text(other)
    capture = open_capture(tmp_path)
    assert capture.fingerprint() == expected and capture.metric


@pytest.mark.parametrize(
    ("text", "what", "remedy"),
    [
        ("", "the file is empty", ""),
        ("\ufeff \n\n", "the file is empty", ""),
        ("image\nimages/a.png\n", "does not state its units", "say # units: metres"),
        ("# units: mm\nimage\nimages/a.png\n", "are mm", "say # units: metres"),
    ],
)
def test_what_a_csv_lacks_is_said_as_a_csv_has_it(
    tmp_path: Path, text: str, what: str, remedy: str
) -> None:
    write(tmp_path)
    (tmp_path / "frames.json").unlink()
    (tmp_path / "frames.csv").write_text(text, encoding="utf-8")
    with pytest.raises(UserError) as error:
        open_capture(tmp_path)
    assert what in error.value.what and remedy in error.value.remedy


def test_what_is_wrong_is_said_where_it_stands(tmp_path: Path) -> None:
    named = {"cameras": {"left": {"fx": "9"}}, "frames": changed(camera="left")}
    wrong = {
        "^the file has a fx": {"fx": "9"},
        "^left of cameras of the file has a fx": named,
        "^the file's units are feet": {"units": "feet"},
    }
    wrong[r"frame 0 \(images/a.png\) has a fx"] = {"frames": changed(fx="9")}
    for what, root in wrong.items():
        with pytest.raises(UserError, match=what):
            open_capture(write(tmp_path, **root))


def test_depth_that_is_missing_is_said_and_outside_is_not_looked_for(tmp_path: Path) -> None:
    capture = open_capture(write(tmp_path, changed(depth="../../depth/a.png")))
    (doubt,) = capture.doubts
    assert "depth ../../depth/a.png is missing" in doubt and "copy or link" in doubt
    with pytest.raises(UserError) as error:
        open_capture(write(tmp_path, changed(image="/data/gone.png")))
    assert "copy or link" in error.value.remedy


@pytest.mark.parametrize(
    "text",
    [
        "",
        "image,fx\n",
        "image,fx,fx\na,1,1\n",
        "image,fx\na\n",
        "image,fx,fy,cx,cy,world_from_cam\nimages/a.png,1,x,1,1,1 2 3\n",
        "image\n\x00\n",
    ],
)
def test_broken_csv_is_one_error(tmp_path: Path, text: str) -> None:
    write(tmp_path)
    (tmp_path / "frames.json").unlink()
    (tmp_path / "frames.csv").write_text(f"# units: metres\n{text}")
    with pytest.raises(UserError) as error:
        open_capture(tmp_path)
    assert error.value.where == tmp_path / "frames.csv"
