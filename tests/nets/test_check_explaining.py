"""A cause is named only if it explains: what is left is small, of nearly all frames, and known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from check_plants import (
    UNITY,
    before_a_turn,
    frames,
    in_parts,
    pose_before_a_turn,
    poses,
    scaled,
)
from PIL import Image
from room_capture import write_scene

from deltas_geom.diagnosis.evidence import residuals
from deltas_nets.captures.capture import Capture, Frame
from deltas_nets.captures.opening import open_capture
from deltas_nets.check.axes import other_axes
from deltas_nets.check.evidence import evidence_of
from deltas_nets.check.finding import Fault, Finding
from deltas_nets.check.guesses import improved_guess
from deltas_nets.check.judging import judge_matches
from deltas_nets.check.matched import Matched, match_capture
from deltas_nets.check.time_shift import poses_of_other_frames
from deltas_nets.check.trying import Case, Tried
from deltas_nets.check.turned import Turn, turned_images, turned_images_of_right_K
from deltas_nets.check.unmatched import unmatched_frames
from deltas_nets.check.verdict import check_capture
from deltas_nets.rooms import render_room
from deltas_nets.weights_file import load_model

Looked = tuple[Capture, Matched]


def written(folder: Path, num_views: int) -> Capture:
    write_scene(folder, render_room(3, num_views=num_views, image_size=(192, 256)))
    for depth in (folder / "depth").iterdir():
        depth.unlink()
    return open_capture(folder)


@pytest.fixture(scope="module")
def few(tmp_path_factory: pytest.TempPathFactory) -> Looked:
    """Six frames: the fewer there are, the more explains them by accident."""
    capture = written(tmp_path_factory.mktemp("room") / "capture", 6)
    return capture, match_capture(capture, load_model())


@pytest.fixture(scope="module")
def some_upright(few: Looked, tmp_path_factory: pytest.TempPathFactory) -> Looked:
    """The six frames, of which every other one shows the middle alone, higher than wide."""
    folder = tmp_path_factory.mktemp("upright")

    def middle(number: int, frame: Frame) -> Frame:
        if number % 2 == 0:
            return frame
        Image.fromarray(frame.read_image()[:, 48:208]).save(folder / f"{number}.png")
        K = frame.K - np.array([[0, 0, 48], [0, 0, 0], [0, 0, 0]])
        return replace(
            frame, K=K, image_path=folder / f"{number}.png", image_size=(frame.image_size[0], 160)
        )

    capture = frames(middle)(few[0])
    return capture, match_capture(capture, load_model())


@pytest.mark.parametrize(
    ("given", "after", "explains"),
    [(6.6, 3.3, False), (29.0, 3.7, False), (4.5, 1.5, False), (2.2, 0.9, True), (6.6, 0.2, True)],
)
def test_what_is_left_must_be_what_clean_captures_leave(
    given: float, after: float, explains: bool
) -> None:
    assert Tried(given, after).explains is explains


def test_a_left_handed_world_of_six_frames_is_no_shift_of_frames(few: Looked) -> None:
    capture, matched = few
    planted = poses(lambda pose: UNITY @ pose @ UNITY)(capture)
    (found,) = judge_matches(planted, matched)[0]
    assert found.cause is Fault.OTHER_AXES and found.mend is not None
    assert judge_matches(found.mend(planted), matched)[0] == []


@pytest.mark.parametrize("with_K", [True, False])
def test_turned_images_are_named_and_their_cameras_found(with_K: bool, few: Looked) -> None:
    capture, matched = few
    planted = frames(before_a_turn if with_K else pose_before_a_turn)(capture)
    evidence = evidence_of(matched)
    case = Case(planted, matched, evidence, residuals(evidence, *matched.views(planted.frames)))
    tried = turned_images(case) if with_K else turned_images_of_right_K(case)
    found = min(tried, key=lambda suspect: suspect.tried.after).finding
    assert found.cause is (Fault.IMAGES_TURNED if with_K else Fault.IMAGES_TURNED_BESIDE_POSES)
    assert "by 90 degrees clockwise" in found.evidence and found.mend is not None
    mended = found.mend(planted).frames
    assert np.allclose(mended.K, capture.frames.K)
    assert np.allclose(mended.cam_from_world, capture.frames.cam_from_world)


@pytest.mark.parametrize(("with_K", "portrait"), [(True, False), (False, True)])
def test_of_mixed_photos_those_of_one_shape_may_be_turned(
    with_K: bool, portrait: bool, some_upright: Looked
) -> None:
    capture, matched = some_upright
    turned = before_a_turn if with_K else pose_before_a_turn
    ids = ("1", "3", "5") if portrait else ("0", "2", "4")
    planted = frames(lambda i, f: turned(i, f) if f.id in ids else f)(capture)
    (found,) = judge_matches(planted, matched)[0]
    assert found.cause is (Fault.IMAGES_TURNED if with_K else Fault.IMAGES_TURNED_BESIDE_POSES)
    assert found.frames == ids and found.mend is not None
    shape = "portrait" if portrait else "landscape"
    assert found.cure.startswith(f"turn the {shape} images back by 90 degrees clockwise")
    mended = found.mend(planted).frames
    assert np.allclose(mended.K, capture.frames.K)
    assert np.allclose(mended.cam_from_world, capture.frames.cam_from_world)


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_a_quarter_and_what_is_left_of_a_turn_are_none(quarters: int, few: Looked) -> None:
    frame = few[0].frame(0)
    there = Turn(quarters, with_K=True).mended(0, frame)
    lying = replace(there, image_size=frame.image_size[:: -1 if quarters % 2 else 1])
    back = Turn(4 - quarters, with_K=True).mended(0, lying)
    assert np.allclose(back.K, frame.K) and np.allclose(back.cam_from_world, frame.cam_from_world)


@pytest.mark.parametrize(("late", "told"), [(1, True), (3, False)])
def test_a_shift_that_leaves_half_of_the_frames_is_none(late: int, told: bool, few: Looked) -> None:
    capture, matched = few
    planted = poses(lambda pose: np.roll(pose, late, 0))(capture)
    found = poses_of_other_frames(planted, matched, evidence_of(matched))
    assert (found is not None) is told


def test_poses_of_two_faults_have_no_single_cause(few: Looked) -> None:
    capture, matched = few
    generator = np.random.default_rng(0)
    planted = poses(lambda pose: pose[generator.permutation(len(pose))])(capture)
    (found,) = judge_matches(planted, matched)[0]
    assert found.cause is Fault.UNEXPLAINED and found.mend is None


@pytest.mark.parametrize("cause", [Fault.UNEXPLAINED, Fault.FEW_MATCHES])
def test_a_guess_that_matches_do_not_confirm_is_not_written(cause: Fault, few: Looked) -> None:
    planted = frames(in_parts)(few[0])

    def mend(capture: Capture) -> Capture:
        return capture

    guess = Finding(Fault.NONSENSE_CALIBRATION, "odd", (), "calibrate", "error", mend)
    doubt = Finding(cause, "off", (), "look", "error")
    improved, left = improved_guess(guess, [doubt], planted)
    assert improved.mend is None and left == [doubt]
    assert improved_guess(guess, [], planted)[0].mend is mend


def test_centimetres_are_told_and_not_mended(few: Looked) -> None:
    capture, matched = few
    planted = poses(lambda pose: scaled(pose, 100))(capture)
    (found,) = judge_matches(planted, matched)[0]
    assert found.cause is Fault.NOT_METRES and found.mend is None
    assert "0.01" in found.cure and found.severity == "warning"


def test_an_image_that_is_upside_down_is_named_with_its_exif(tmp_path: Path) -> None:
    capture = written(tmp_path / "capture", 6)
    path = capture.frames["2"].image_path
    image = Image.open(path)
    exif = image.getexif()
    exif[0x112] = 3
    image.transpose(Image.Transpose.ROTATE_180).save(path, exif=exif)
    matched = match_capture(capture, load_model())
    (found,) = unmatched_frames(capture, matched)
    assert found.frames == ("2",) and found.severity == "warning"
    assert "EXIF" in found.evidence and "orientation 3" in found.evidence


def test_nothing_is_said_of_matches_where_no_image_can_be_read(tmp_path: Path) -> None:
    capture = written(tmp_path / "capture", 3)
    for grey, frame in enumerate(capture.frames.values()):
        Image.fromarray(np.full((192, 256), 900 + grey, np.uint16)).save(frame.image_path)
    (found,) = check_capture(capture, load_model()).findings
    assert found.cause is Fault.IMAGES_UNREADABLE and found.mend is None


@pytest.mark.parametrize(("given", "named"), [(4.0, False), (6.0, True)])
def test_of_so_many_axes_one_must_leave_a_quarter(given: float, named: bool, few: Looked) -> None:
    class OneFits:
        """All axes leave 1.2 px of it: less than half of 4 px, less than a quarter of 6."""

        capture = few[0]

        def mended(self, mend: object) -> Tried:
            return Tried(given, 1.2)

    assert (other_axes(OneFits()) is not None) == named  # type: ignore[arg-type]
