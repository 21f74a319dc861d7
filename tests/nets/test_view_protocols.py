"""Which views go together by the paper's gaps and by DeepVideoMVS's key frames."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from small_capture import write_capture

from deltas_nets.captures.capture import Capture, Frame
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.opening import open_capture
from deltas_nets.errors import UserError
from deltas_nets.evaluate.protocols.deep_video import (
    deep_video_view_sets,
    penalty,
    pose_distance,
)
from deltas_nets.evaluate.protocols.fixed_gap import fixed_gap_view_sets, gap_of
from deltas_nets.evaluate.protocols.view_protocol import ViewProtocol

small = st.floats(-0.5, 0.5)
vectors = st.tuples(small, small, small)


def pose(turn: tuple[float, ...], shift: tuple[float, ...]) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    matrix[:3, 3] = shift
    return matrix


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """Sixteen frames, 4 cm apart; the tenth has lost its pose."""
    folder = write_capture(tmp_path_factory.mktemp("walk") / "a", 16, step=0.04)
    (folder / "pose" / "10.txt").write_text("-inf " * 16)
    return open_capture(folder)


def test_the_papers_lengths_and_gaps() -> None:
    assert [gap_of(views) for views in (2, 3, 4, 5, 7)] == [20, 20, 15, 12, 10]


@given(views=st.integers(2, 5), gap=st.integers(1, 4), every=st.integers(1, 4))
def test_sources_are_the_gap_apart_around_an_anchor(
    walk: Capture, views: int, gap: int, every: int
) -> None:
    try:
        found = fixed_gap_view_sets(walk, views, gap=gap, every=every)
    except UserError:
        found = ()
    expected = []
    for anchor in range(0, 16, every):
        first = anchor - gap * (views // 2)
        numbers = [first + gap * step for step in range(views)]
        if all(0 <= number < 16 and number != 10 for number in numbers):
            expected.append((str(anchor), {str(n) for n in numbers} - {str(anchor)}))
    assert [(s.anchor, set(s.sources)) for s in found] == expected
    nearest = [[abs(int(id) - int(s.anchor)) for id in s.sources] for s in found]
    assert all(steps == sorted(steps) for steps in nearest)


@given(turn=vectors, shift=vectors, about=vectors, moved=vectors)
@settings(max_examples=40)
def test_pose_distance_is_the_same_both_ways_and_in_any_world(
    turn: tuple[float, ...],
    shift: tuple[float, ...],
    about: tuple[float, ...],
    moved: tuple[float, ...],
) -> None:
    one, other = pose((0, 0, 0), (0, 0, 0)), pose(turn, shift)
    world = pose(about, moved)
    expected = pose_distance(one, other)
    assert pose_distance(other, one) == pytest.approx(expected, abs=1e-6)
    assert pose_distance(one @ world, other @ world) == pytest.approx(expected, abs=1e-6)
    # 3 - tr R = 4 sin^2(angle / 2).
    angle, centre = np.linalg.norm(turn), np.linalg.norm(other[:3, :3].T @ other[:3, 3])
    by_angle = centre**2 + 8 / 3 * np.sin(angle / 2) ** 2
    assert expected**2 == pytest.approx(by_angle, abs=1e-9)


def test_fifteen_centimetres_without_a_turn_are_best_and_less_is_worse_than_more() -> None:
    here = np.eye(4)

    def at(x: float, turn: float = 0) -> float:
        return penalty(here, pose((0, turn, 0), (x, 0, 0)))

    assert at(0.15) == pytest.approx(0)
    assert at(0.10) == pytest.approx(5 * 0.05**2)
    assert at(0.20) == pytest.approx(0.05**2)
    assert at(0.15, 0.3) == pytest.approx(8 / 3 * np.sin(0.15) ** 2, rel=1e-6)


def test_key_frames_look_back_at_the_best_of_those_before_them(walk: Capture) -> None:
    found = deep_video_view_sets(walk, 3)
    # 4 cm a frame: every third is 0.12 away; 10 is lost, and 9 and 12 are key frames.
    assert [s.anchor for s in found] == ["3", "6", "9", "12", "15"]
    # 0.12, 0.24 and 0.36 m away: 5 (0.03)^2, 0.09^2 and 0.21^2.
    assert [s.sources for s in found] == [
        ("0",),
        ("3", "0"),
        ("6", "3"),
        ("9", "6"),
        ("12", "9"),
    ]


def test_a_rule_is_recorded_by_name_and_version(walk: Capture) -> None:
    assert ViewProtocol("paper", 3, gap=2, every=4).of(walk).record == {
        "name": "paper",
        "version": 1,
        "views": 3,
        "gap": 2,
        "anchor": "middle",
        "anchors_every": 4,
    }
    assert ViewProtocol("deepvideomvs").of(walk).record["views"] == 3
    assert ViewProtocol(views=2).of(walk).record == {"name": "chosen", "version": 1, "views": 2}


def test_ids_may_be_nanoseconds_and_not_more() -> None:
    def at(first: int) -> Capture:
        ids = (str(first + step) for step in range(4))
        frames = [Frame(id, Path(), (4, 4), np.eye(3), np.eye(4)) for id in ids]
        return Capture(Path("walk"), Frames.of(frames, Path()), {})

    assert len(fixed_gap_view_sets(at(2**63 - 4), 3, gap=1, every=1)) == 2
    with pytest.raises(UserError, match="frames without numbers"):
        fixed_gap_view_sets(at(2**63 - 3), 3, gap=1, every=1)


def test_what_has_no_sequence_is_refused(walk: Capture, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no frame that 20 divides has 3 views 20 frames apart"):
        ViewProtocol("paper").of(walk)
    still = open_capture(write_capture(tmp_path / "still", 3, step=0.0))
    with pytest.raises(UserError, match=r"no frame is 0\.1 m"):
        deep_video_view_sets(still, 3)
