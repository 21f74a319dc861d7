"""Captures: what is read, what is lost, and one line of error for everything else."""

import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from small_capture import K_FILE

from deltas_nets.captures.capture import Capture, Frame, Lost
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.points import Observations, SparsePoints
from deltas_nets.captures.readers.poses import world_from_cam_inverse
from deltas_nets.errors import UserError

MakeCapture = Callable[..., Path]


def test_an_error_is_one_line_of_what_where_remedy() -> None:
    error = UserError("it\nbroke", Path("a/b.txt"), "mend it")
    assert str(error) == "it broke, a/b.txt: mend it"
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_frames_come_in_the_order_of_their_numbers(make_capture: MakeCapture) -> None:
    capture = open_capture(make_capture(num_frames=11))
    assert list(capture.frames) == list(map(str, range(11)))
    assert capture.lost == {}


@given(
    st.lists(st.tuples(st.integers(0, 9), st.integers(0, 3)), max_size=20), st.integers(0, 2**4 - 1)
)
def test_each_frame_knows_the_points_that_it_sees(seen: list[tuple[int, int]], kept: int) -> None:
    table = np.array(seen, dtype=np.int64).reshape(-1, 2)
    observed = Observations(table[:, 0], table[:, 1], np.zeros((len(seen), 2)))
    points = SparsePoints(np.zeros((10, 3)), np.zeros((10, 3), np.uint8), np.zeros(10), observed)
    frames = [Frame(str(id), Path(), (4, 4), np.eye(3), np.eye(4)) for id in range(4)]
    capture = Capture(Path(), Frames.of(frames, Path()), {}, points=points)
    found = [points.tolist() for points in capture.points_of_frame]
    assert found == [[point for point, place in seen if place == frame] for frame in range(4)]
    mask = np.array([bool(kept >> frame & 1) for frame in range(4)])
    fewer = capture.without(mask, Lost("no depth", UserError("it has none", Path(), "go on")))
    left = [points for points, gone in zip(found, mask, strict=True) if not gone]
    assert [points.tolist() for points in fewer.points_of_frame][: len(left)] == left


def test_poses_are_inverted(capture: Capture) -> None:
    assert capture.frame(2).cam_from_world[:3, 3] == pytest.approx([-0.30, 0, 0])


def test_images_and_depth_are_read(make_capture: MakeCapture) -> None:
    folder = make_capture(image_size=(48, 64), depth_size=(24, 32))
    millimetres = np.full((24, 32), 1500, dtype=np.uint16)
    millimetres[0, 0], millimetres[0, 1] = 0, 65535
    Image.fromarray(millimetres).save(folder / "depth" / "1.png")
    frame = open_capture(folder).frame(1)
    assert frame.image_size == (48, 64)
    assert frame.read_image().shape == (48, 64, 3)
    depth = frame.read_depth()
    assert depth.dtype == np.float32
    assert depth[0, :3] == pytest.approx([0, 0, 1.5])


def test_a_grey_image_is_read_as_colour(make_capture: MakeCapture) -> None:
    folder = make_capture()
    Image.new("L", (64, 48), 7).save(folder / "color" / "0.jpg")
    assert open_capture(folder).frame(0).read_image().shape == (48, 64, 3)


@pytest.mark.parametrize("nest", ["scans", "scans_test"])
def test_a_single_nested_scene_is_found(
    make_capture: MakeCapture, tmp_path: Path, nest: str
) -> None:
    make_capture(path=tmp_path / "top" / nest / "scene0000_00")
    assert open_capture(tmp_path / "top").path == tmp_path / "top" / nest / "scene0000_00"


@pytest.mark.parametrize("value", ["nan", "-inf", "inf"])
def test_a_pose_that_is_not_finite_is_lost(make_capture: MakeCapture, value: str) -> None:
    folder = make_capture()
    (folder / "pose" / "1.txt").write_text("\n".join([f"{value} " * 4] * 4))
    capture = open_capture(folder)
    assert list(capture.frames) == ["0", "2", "3"]
    assert list(capture.lost) == ["1"]
    with pytest.raises(UserError) as error:
        capture.frame(1)
    assert error.value is capture.lost["1"].error
    assert error.value.where == folder / "pose" / "1.txt"


def test_an_image_without_pose_is_lost_and_a_pose_without_image_ignored(
    make_capture: MakeCapture,
) -> None:
    folder = make_capture()
    (folder / "pose" / "2.txt").unlink()
    (folder / "color" / "3.jpg").unlink()
    capture = open_capture(folder)
    assert (list(capture.frames), list(capture.lost)) == (["0", "1"], ["2"])


def test_an_unknown_frame_names_the_nearest(capture: Capture) -> None:
    with pytest.raises(UserError) as error:
        capture.frame(99)
    assert "no frame 99" in error.value.what and error.value.where == capture.path
    assert error.value.remedy.endswith("0, 1, 2, 3")


def test_a_three_by_three_is_as_good_as_four_by_four(make_capture: MakeCapture) -> None:
    folder = make_capture()
    (folder / K_FILE).write_text("60 0 32 0 0 60 24 0 0 0 1 0 0 0 0 1")
    four = open_capture(folder).frame(0).K
    (folder / K_FILE).write_text("60 0 32 0 60 24 0 0 1")
    assert np.array_equal(four, open_capture(folder).frame(0).K)


@settings(deadline=None)
@given(
    quaternion=st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(
        lambda q: float(np.linalg.norm(q)) > 0.1
    ),
    centre=st.lists(st.floats(-1000, 1000), min_size=3, max_size=3),
)
def test_the_inverse_of_a_printed_pose_undoes_it(
    quaternion: list[float], centre: list[float]
) -> None:
    w, x, y, z = np.array(quaternion) / np.linalg.norm(quaternion)
    world_from_cam = np.eye(4)
    world_from_cam[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    world_from_cam[:3, 3] = centre
    printed = np.round(world_from_cam, 6)
    inverse = world_from_cam_inverse(printed, path=Path("pose/0.txt"))
    rotation = inverse[:3, :3]
    assert np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-14
    # The camera's centre goes to the origin whatever the rounding of the rotation, in metres.
    assert np.abs(rotation @ printed[:3, 3] + inverse[:3, 3]).max() < 1e-9
    assert np.abs(rotation @ world_from_cam[:3, :3] - np.eye(3)).max() < 5e-6


@pytest.mark.shared
@pytest.mark.parametrize(
    ("name", "num_frames", "image_size", "depth_size"),
    [
        ("hololens", 186, (360, 540), (360, 540)),
        ("sevenscenes_reg", 67, (480, 640), (480, 640)),
        ("scannet_sample", 3, (968, 1296), (480, 640)),
    ],
)
def test_real_captures_open(
    shared_data: Path,
    name: str,
    num_frames: int,
    image_size: tuple[int, int],
    depth_size: tuple[int, int],
) -> None:
    capture = open_capture(shared_data / name)
    frame = next(iter(capture.frames.values()))
    assert (len(capture.frames), len(capture.lost)) == (num_frames, 0)
    assert frame.read_image().shape == (*image_size, 3)
    assert frame.read_depth().shape == depth_size
    assert frame.read_depth().max() < 20
