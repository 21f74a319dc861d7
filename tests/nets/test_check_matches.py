"""Own matches of a capture tell what is wrong with its cameras; the cure mends it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import cv2
import numpy as np
import pytest
import torch
from check_plants import MATCHES, poses, shaken, with_depth_of_a_kinect
from room_capture import write_scene

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.saving import save_capture
from deltas_nets.check import scale
from deltas_nets.check.finding import Fault, Finding
from deltas_nets.check.judging import judge_matches
from deltas_nets.check.matched import Matched, _alone, match_capture
from deltas_nets.check.quick import quick_findings
from deltas_nets.check.verdict import check_capture
from deltas_nets.rooms import render_room
from deltas_nets.weights_file import load_model

REAL = ("hololens", "sevenscenes_reg", "tum_fr3_cabinet")
BY_DAY = (
    "inverted",
    "K transposed",
    "one K in three",
    "five frames late",
    "rotations inverted",
    "one pose in ten",
)


class Looked(NamedTuple):
    """A capture without faults, and its matches, which no fault of cameras changes."""

    capture: Capture
    matched: Matched

    def judged(self, planted: Capture) -> list[Finding]:
        """Findings of the capture with other cameras, or fewer frames."""
        place = {id: position for position, id in enumerate(planted.frames)}
        ids = [self.capture.frames.id_at(position) for position in self.matched.positions]
        kept = [view for view, id in enumerate(ids) if id in place]
        matched = Matched(
            tuple(place[ids[view]] for view in kept),
            self.matched.pixels[kept],
            tuple(self.matched.sizes[view] for view in kept),
            {},
        )
        return judge_matches(planted, matched)[0]


Look = Callable[[str], Looked]


@pytest.fixture(scope="module")
def look(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Look:
    """A capture by name, matched when it is first asked for."""
    known: dict[str, Looked] = {}

    def find(name: str) -> Looked:
        if name not in known:
            if name == "room":
                folder = tmp_path_factory.mktemp("room") / "capture"
                write_scene(folder, render_room(3, num_views=11, image_size=(192, 256)))
            else:
                folder = request.getfixturevalue("shared_data") / name
            capture = open_capture(folder)
            known[name] = Looked(capture, match_capture(capture, load_model()))
        return known[name]

    return find


def assert_named_and_mended(looked: Looked, name: str) -> None:
    plant, cause = MATCHES[name]
    planted = plant(looked.capture)
    (found,) = looked.judged(planted)
    assert found.cause is cause, (found, cause)
    assert found.mend is not None and found.cure and found.severity == "error"
    assert looked.judged(found.mend(planted)) == []


def assert_depth_of_a_kinect_is_named(looked: Looked, folder: Path) -> None:
    planted = with_depth_of_a_kinect(looked.capture, folder)
    (found,) = looked.judged(planted)
    assert found.cause is Fault.DEPTH_NOT_REGISTERED and "585" in found.evidence
    assert found.mend is not None and looked.judged(found.mend(planted)) == []


def test_a_room_that_is_well_raises_no_alarm(look: Look) -> None:
    looked = look("room")
    found, figures = judge_matches(*looked)
    assert found == [] and quick_findings(looked.capture) == []
    assert figures.residual < 0.3 and figures.fit == 1 and figures.looked_at == 11


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n in BY_DAY else pytest.mark.slow) for n in MATCHES]
)
def test_faults_planted_in_a_room_are_named_and_mended(name: str, look: Look) -> None:
    assert_named_and_mended(look("room"), name)


def test_poses_that_are_each_a_little_off_are_told(look: Look) -> None:
    looked = look("room")
    (found,) = looked.judged(poses(shaken)(looked.capture))
    assert found.cause is Fault.POSES_SHAKE and found.severity == "warning" and not found.frames
    assert "degrees of its own" in found.evidence and "bundle adjustment" in found.cure


def test_depth_of_another_camera_in_a_room_is_named(look: Look, tmp_path: Path) -> None:
    assert_depth_of_a_kinect_is_named(look("room"), tmp_path)


@pytest.mark.parametrize(
    ("layout", "cure"),
    [
        ("frames.json", "state a depth_scale of 1000"),
        ("transforms_train.json", "state a depth_unit_scale_factor of 0.001"),
        ("Polycam", "multiply the numbers of depth files by 0.2"),
    ],
)
def test_steps_of_depth_are_told_in_the_words_of_the_files(
    layout: str, cure: str, look: Look
) -> None:
    looked = look("room")
    planted = replace(MATCHES["depth of 1/5000 m"][0](looked.capture), layout=layout)
    (found,) = looked.judged(planted)
    assert found.cause is Fault.DEPTH_SCALE and found.cure.startswith(cure)


@pytest.mark.parametrize(
    ("factor", "cause", "cure"),
    [
        (1000, Fault.DEPTH_SCALE, "multiply the numbers of depth files by 0.001"),
        (100, Fault.DEPTH_SCALE, "multiply the numbers of depth files by 0.01"),
        (5, Fault.WRONG_SCALE, "or, if poses are right, depth by 0."),
    ],
)
def test_a_cure_of_depth_in_floats_states_no_steps_as_none_would_count(
    factor: float, cause: Fault, cure: str, look: Look, tmp_path: Path
) -> None:
    looked = look("room")
    stored = []
    for frame in looked.capture.frames.values():
        np.save(tmp_path / f"{frame.id}.npy", frame.read_depth() * factor)
        stored.append(replace(frame, depth_path=tmp_path / f"{frame.id}.npy"))
    planted = replace(looked.capture, frames=Frames.of(stored, tmp_path))
    (found,) = looked.judged(planted)
    assert found.cause is cause and cure in found.cure and "1/" not in found.evidence
    assert found.mend is not None
    mended = found.mend(planted)
    assert looked.judged(mended) == []
    if cause is Fault.DEPTH_SCALE:  # poses that are right are not brought to the unit of depth
        assert np.array_equal(mended.frames.cam_from_world, planted.frames.cam_from_world)
        save_capture(mended, tmp_path / "mended", "own")
        assert looked.judged(open_capture(tmp_path / "mended")) == []


def test_inverse_depth_is_no_reason_to_scale_poses(look: Look, tmp_path: Path) -> None:
    looked = look("room")
    stored = []
    for frame in looked.capture.frames.values():
        depth = frame.read_depth()
        inverse = np.divide(10, depth, out=np.zeros_like(depth), where=depth > 0)
        np.save(tmp_path / f"{frame.id}.npy", inverse)
        stored.append(replace(frame, depth_path=tmp_path / f"{frame.id}.npy"))
    planted = replace(looked.capture, frames=Frames.of(stored, tmp_path))
    (found,) = looked.judged(planted)
    assert found.cause is Fault.DEPTH_UNREADABLE and found.mend is None
    assert "no unit explains" in found.evidence and "inverse depth" in found.cure


def test_floats_in_metres_that_are_read_as_millimetres_are_told(look: Look) -> None:
    looked = look("room")
    stored = [
        replace(frame, depth_path=Path("depth.pfm"), depth_unit=0.001, depth_scale=1e6)
        for frame in looked.capture.frames.values()
    ]
    planted = replace(looked.capture, frames=Frames.of(stored), layout="transforms.json")
    known = {0: None, 1: None}
    assert scale._unit_meant(planted, known, 0.00103) == (0.001, 1.0)  # type: ignore[arg-type]
    found = scale._of_floats((0.001, 1.0), 0.00103, 99, planted.layout)
    assert found.cure == "state a depth_unit_scale_factor of 1"
    assert found.evidence.endswith("depth is in metres")


@pytest.mark.parametrize("fault", ["none", "inverted", "one pose in ten"])
def test_three_matches_in_ten_may_be_wrong(fault: str, look: Look) -> None:
    capture, matched = look("room")
    generator = torch.Generator().manual_seed(0)
    anywhere = torch.rand(matched.pixels.shape, generator=generator).double()
    anywhere *= torch.tensor(matched.sizes[0][::-1])
    wrong = torch.rand(matched.pixels.shape[:2], generator=generator) < 0.16  # of the pixels
    spoiled = torch.where((wrong & matched.seen)[..., None], anywhere, matched.pixels)
    looked = Looked(capture, matched._replace(pixels=spoiled))
    if fault == "none":
        assert looked.judged(capture) == []
    else:
        assert_named_and_mended(looked, fault)


@pytest.mark.parametrize(("frames", "causes"), [(2, []), (4, [Fault.K_OF_OTHER_SIZE])])
def test_a_pair_that_nearly_fits_accuses_no_camera(
    frames: int, causes: list[Fault], look: Look
) -> None:
    looked = look("room")
    some = [
        replace(frame, K=np.diag([1.1, 1.1, 1.0]) @ frame.K)
        for frame in list(looked.capture.frames.values())[:frames]
    ]
    planted = replace(looked.capture, frames=Frames.of(some, looked.capture.frames.folder))
    assert [found.cause for found in looked.judged(planted)] == causes


class Described(NamedTuple):
    """Three frames of which the middle one matches none."""

    frames: SimpleNamespace
    known: dict[int, bool]

    def match(self, one: int, other: int) -> bool:
        return False


@pytest.mark.parametrize(
    ("turn", "accused"), [((0, 4, 0), (1,)), ((0, 30, 0), ()), ((0, 0, 90), ())]
)
def test_frames_that_look_elsewhere_or_are_turned_need_not_match(
    turn: tuple[float, float, float], accused: tuple[int]
) -> None:
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1, :3, :3] = cv2.Rodrigues(np.radians(turn))[0]
    known = dict.fromkeys(range(3), True)
    described = Described(SimpleNamespace(cam_from_world=poses), known)
    nowhere = torch.zeros(0, 2)
    assert _alone(described, [{0: nowhere, 2: nowhere}]) == accused  # type: ignore[arg-type]


def test_frames_that_share_nothing_say_that_nothing_can_be_told(look: Look) -> None:
    capture, matched = look("room")
    blind = matched._replace(pixels=torch.full_like(matched.pixels, torch.nan))
    (found,), figures = judge_matches(capture, blind)
    assert found.cause is Fault.FEW_MATCHES and figures.pairs == 0


@pytest.mark.shared
@pytest.mark.parametrize(
    "name", ["tum_fr1_desk9", *(pytest.param(n, marks=pytest.mark.slow) for n in REAL)]
)
def test_real_captures_raise_no_alarm(name: str, look: Look) -> None:
    looked = look(name)
    assert judge_matches(*looked)[0] == [] and quick_findings(looked.capture) == []


@pytest.mark.slow
@pytest.mark.shared
@pytest.mark.parametrize("fault", [fault for fault in MATCHES if fault != "one pose in ten"])
@pytest.mark.parametrize("name", REAL)
def test_faults_of_real_captures_are_named_and_mended(name: str, fault: str, look: Look) -> None:
    assert_named_and_mended(look(name), fault)


@pytest.mark.slow
@pytest.mark.shared
@pytest.mark.parametrize("name", REAL)
def test_frames_that_were_moved_are_named_all_but_one_in_ten(name: str, look: Look) -> None:
    looked = look(name)
    plant, cause = MATCHES["one pose in ten"]
    planted = plant(looked.capture)
    (found,) = check_capture(planted, load_model()).findings
    change = planted.frames.cam_from_world != looked.capture.frames.cam_from_world
    moved = set(np.array(list(planted.frames))[change.any(axis=(1, 2))])
    named = set(found.frames)
    # Of one that moved along what it sees, matches tell little.
    assert found.cause is cause and len(named & moved) >= 0.9 * len(moved)
    assert len(named - moved) <= 1 and found.mend is not None
    assert looked.judged(found.mend(planted)) == []


@pytest.mark.slow
@pytest.mark.shared
@pytest.mark.parametrize("name", REAL)
def test_depth_of_another_camera_is_named(name: str, look: Look, tmp_path: Path) -> None:
    assert_depth_of_a_kinect_is_named(look(name), tmp_path)
