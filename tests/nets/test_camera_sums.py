"""Cameras are known again in another format, and never taken for others."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_maps import write_maps

from deltas_nets.captures.camera_sums import are_sums_of, camera_sums
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import Frame, Lens
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.rotations import rotations_of
from deltas_nets.captures.saving import save_capture
from deltas_nets.errors import UserError
from deltas_nets.outputs.summary import CAMERA_SUMS, SUMMARY
from deltas_nets.outputs.their_capture import made_of


def posed(capture: Capture, *, away: float = 1.0, lens: Lens | None = None) -> Capture:
    """The capture with poses and focal lengths whose numbers are no round ones."""
    numbers = np.random.default_rng(0)
    frames = []
    for frame in capture.frames.values():
        pose, K = np.eye(4), frame.K.copy()
        pose[:3, :3] = rotations_of(numbers.normal(size=4))
        pose[:3, 3] = away * numbers.normal(size=3)
        K[:2] *= np.pi / 3
        frames.append(replace(frame, cam_from_world=pose, K=K, lens=lens))
    return replace(capture, frames=Frames.of(frames, capture.path))


@pytest.mark.parametrize("format", ["own", "transforms", "colmap", "colmap-bin", "scannet"])
@pytest.mark.parametrize("away", [1.0, 5e6])
def test_maps_of_a_capture_are_those_of_the_same_in_another_format(
    capture: Capture, tmp_path: Path, format: Any, away: float
) -> None:
    lens = None if format == "scannet" else Lens("OPENCV", (0.1 / 3, -0.01 / 7, 1e-4 / 3, 0.0))
    capture = posed(capture, away=away, lens=lens)
    maps = write_maps(capture, tmp_path / "maps")
    save_capture(capture, tmp_path / format, format)
    other = open_capture(tmp_path / format)
    assert other.fingerprint() != capture.fingerprint()
    assert made_of(other, maps).ids == tuple(capture.frames)


def moved(frame: Frame, by: float) -> Frame:
    pose = frame.cam_from_world.copy()
    pose[0, 3] += by
    return replace(frame, cam_from_world=pose)


def turned(frame: Frame, by: float) -> Frame:
    pose = frame.cam_from_world.copy()
    turn = rotations_of(np.array([np.cos(by / 2), 0, np.sin(by / 2), 0]))
    pose[:3] = turn @ pose[:3]
    return replace(frame, cam_from_world=pose)


def longer(frame: Frame, by: float) -> Frame:
    K = frame.K.copy()
    K[0, 0] += by
    return replace(frame, K=K)


def bent(frame: Frame, by: float) -> Frame:
    assert frame.lens is not None
    first, *others = frame.lens.coefficients
    return replace(frame, lens=Lens(frame.lens.model, (first + by, *others)))


@pytest.mark.parametrize("change", [moved, turned, longer, bent])
@pytest.mark.parametrize("which", [(2,), (0, 1, 2, 3)])
@given(power=st.floats(-6, 3), sign=st.sampled_from((-1, 1)))
def test_other_cameras_are_told_from_the_same(
    change: Callable[[Frame, float], Frame], which: tuple[int, ...], power: float, sign: int
) -> None:
    capture, by = posed(of_frames(), lens=Lens("OPENCV", (0.1, 0.0, 0.0, 0.0))), sign * 10**power
    frames = list(capture.frames.values())
    others = [change(one, by) if i in which else one for i, one in enumerate(frames)]
    assert are_sums_of(camera_sums(capture.frames), capture.frames)
    assert not are_sums_of(camera_sums(capture.frames), Frames.of(others))


def of_frames() -> Capture:
    K = np.array([[64, 0, 31.5], [0, 64, 23.5], [0, 0, 1]])
    frames = [Frame(str(i), Path(f"{i}.jpg"), (48, 64), K, np.eye(4)) for i in range(4)]
    return Capture(Path(), Frames.of(frames), {})


@pytest.mark.parametrize(
    "change",
    [
        lambda frame: replace(frame, id=f"1{frame.id}"),
        lambda frame: replace(frame, image_size=(48, 65)),
        lambda frame: replace(frame, lens=Lens("OPENCV_FISHEYE", frame.lens.coefficients)),
        lambda frame: replace(frame, lens=None),
    ],
)
def test_other_ids_sizes_and_lenses_are_other_cameras(change: Callable[[Frame], Frame]) -> None:
    capture = posed(of_frames(), lens=Lens("OPENCV", (0.0, 0.0, 0.0, 0.0)))
    others = Frames.of(map(change, capture.frames.values()))
    assert not are_sums_of(camera_sums(capture.frames), others)


def test_poses_in_another_order_are_other_cameras() -> None:
    capture = posed(of_frames())
    arrays = capture.frames.arrays
    rolled = arrays._replace(cam_from_world=np.roll(arrays.cam_from_world, 1, axis=0))
    assert not are_sums_of(camera_sums(capture.frames), Frames(Path(), rolled))


@pytest.mark.parametrize("recorded", [None, {}, 3, {"sums": 1}, {"sums": [[1.0] * 8] * 3}])
def test_what_is_recorded_otherwise_is_of_no_capture(recorded: object) -> None:
    frames = of_frames().frames
    assert not are_sums_of(recorded, frames)
    if isinstance(recorded, dict):
        assert not are_sums_of({**camera_sums(frames), **recorded, "sums": "x"}, frames)


def test_maps_from_before_sums_were_recorded_are_known_by_their_hash(
    capture: Capture, tmp_path: Path
) -> None:
    capture = posed(capture)
    maps = write_maps(capture, tmp_path / "maps")
    summary = json.loads((maps / SUMMARY).read_text())
    del summary[CAMERA_SUMS]
    (maps / SUMMARY).write_text(json.dumps(summary))
    assert made_of(capture, maps).ids == tuple(capture.frames)
    save_capture(capture, tmp_path / "own", "own")
    with pytest.raises(UserError, match="other cameras"):
        made_of(open_capture(tmp_path / "own"), maps)
