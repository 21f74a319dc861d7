"""A lens that is stated but not there, and one that is there but not stated, are named and mended.

`Looked` of test_check_matches keeps matches; these change the images that are matched.
"""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from room_capture import write_scene

from deltas_geom import Lens
from deltas_geom.cameras.pixels import pixel_grid
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import Lens as FrameLens
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.opening import open_capture
from deltas_nets.check.finding import Fault, Finding
from deltas_nets.check.judging import judge_matches
from deltas_nets.check.matched import match_capture
from deltas_nets.rooms import render_room
from deltas_nets.weights_file import load_model

K1 = -0.3
FISHEYE = FrameLens("OPENCV_FISHEYE", (0.0, 0.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    folder = tmp_path_factory.mktemp("room") / "capture"
    write_scene(folder, render_room(14, num_views=11, image_size=(192, 256)))
    for depth in (folder / "depth").iterdir():
        depth.unlink()  # it is not of the bent images
    return open_capture(folder)


def with_lens(capture: Capture, lens: FrameLens | None) -> Capture:
    frames = [replace(frame, lens=lens) for frame in capture.frames.values()]
    return replace(capture, frames=Frames.of(frames, capture.frames.folder))


def bent(capture: Capture, folder: Path) -> Capture:
    """The photos that a lens with `K1` would have taken, with cameras that do not say so."""
    frames = []
    for frame in capture.frames.values():
        K = torch.from_numpy(frame.K.copy())
        lens = Lens(K, torch.tensor([K1], dtype=torch.float64), "SIMPLE_RADIAL")
        grid = pixel_grid(frame.image_size, dtype=torch.float64).reshape(-1, 2)
        rays = lens.unproject(grid).rays
        seen = ((rays / rays[:, 2:]) @ K.T)[:, :2].numpy().astype(np.float32)
        x, y = seen.reshape(*frame.image_size, 2).transpose(2, 0, 1)
        path = folder / f"{frame.id}.png"
        pixels = cv2.remap(frame.read_image()[..., ::-1].copy(), x, y, cv2.INTER_CUBIC)
        assert cv2.imwrite(str(path), pixels)
        frames.append(replace(frame, image_path=path))
    return replace(capture, frames=Frames.of(frames, folder))


def judged(capture: Capture) -> list[Finding]:
    return judge_matches(capture, match_capture(capture, load_model()))[0]


@pytest.mark.parametrize("lens", [FISHEYE, FrameLens("SIMPLE_RADIAL", (K1,))])
def test_a_lens_that_was_undone_before_is_named_and_taken_out(
    lens: FrameLens, room: Capture
) -> None:
    planted = with_lens(room, lens)
    (found,) = judged(planted)
    assert found.cause is Fault.LENS_TWICE and lens.model in found.cure
    assert found.mend is not None
    assert {frame.lens for frame in found.mend(planted).frames.values()} == {None}
    assert judged(found.mend(planted)) == []


def test_a_lens_that_nobody_stated_is_named_and_measured(room: Capture, tmp_path: Path) -> None:
    planted = bent(room, tmp_path)
    (found,) = judged(planted)
    assert found.cause is Fault.LENS_MISSING and found.mend is not None
    mended = found.mend(planted)
    (lens,) = {frame.lens for frame in mended.frames.values()}
    assert lens is not None and lens.coefficients[0] == pytest.approx(K1, abs=0.03)
    assert judged(mended) == []


def test_a_lens_that_is_there_and_stated_raises_no_alarm(room: Capture, tmp_path: Path) -> None:
    capture = with_lens(bent(room, tmp_path), FrameLens("SIMPLE_RADIAL", (K1,)))
    assert judged(capture) == []
