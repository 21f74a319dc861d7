"""What maps say of each other, and how far they may be off."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from fused_scenes import SIZE, looking_at, view_of, wall
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from deltas_nets.captures.capture import Capture, Frame
from deltas_nets.captures.frames import Frames
from deltas_nets.fuse import DepthView, agreeing, agreement
from deltas_nets.fuse.deviation import std_of_confidence
from deltas_nets.fuse.neighbours import neighbours


@given(x=st.floats(-0.3, 0.3), off=st.floats(-0.2, 0.2))
def test_maps_agree_within_the_deviation_of_their_difference(x: float, off: float) -> None:
    view, other = wall(2.0, std=0.1), wall(2.0 + off, x=x, std=0.1)
    limit = 0.5 * math.hypot(0.1, 0.1)
    if abs(abs(off) - limit) < 1e-3:
        return
    found = agreement(view, [other])
    middle = (slice(16, 32), slice(24, 40))  # which both see
    assert (found.agree[middle] == (abs(off) < limit)).all()
    assert (found.against[middle] == (off > limit)).all()  # only what is seen through is wrong


def test_others_say_nothing_of_what_they_do_not_see() -> None:
    away = looking_at(torch.tensor([0.0, 0, -5]).double(), torch.zeros(3).double())
    holes = view_of(torch.zeros(SIZE))
    found = agreement(wall(2.0), [view_of(torch.ones(SIZE), away), holes])
    assert not found.agree.any()
    assert not found.against.any()


def test_depth_stays_where_more_agree_than_see_through() -> None:
    right, wrong = wall(2.0), view_of(torch.full(SIZE, 1.0))
    assert agreeing(right, [right, right]).depth.any()
    assert not agreeing(wrong, [right, right]).depth.any()
    assert not agreeing(right, []).depth.any()
    assert not agreeing(right, [right, wall(3.0)]).depth.any()
    assert not agreeing(right, [right], least=2).depth.any()


@given(relative=st.floats(0.02, 1.0), depth=st.floats(0.1, 50.0))
def test_a_confidence_gives_the_deviation_that_it_was_made_of(
    relative: float, depth: float
) -> None:
    probability = 1 - math.exp(-0.05 / (relative / math.sqrt(2)))  # as DepthPrediction.confidence
    byte = torch.full((1, 1), round(255 * probability), dtype=torch.uint8)
    std = float(std_of_confidence(torch.full((1, 1), depth), byte))
    assert_close(std, relative * depth, rtol=0.06, atol=0)


@pytest.mark.parametrize("byte", [0, 255])
def test_any_confidence_gives_a_deviation(byte: int) -> None:
    std = std_of_confidence(torch.tensor([[0.0, 2.0]]), torch.full((1, 2), byte, dtype=torch.uint8))
    assert std.isfinite().all()
    assert (std > 0).all()


def captured(views: list[DepthView]) -> Capture:
    frames = [
        Frame(str(n), Path(f"{n}.png"), SIZE, view.K.numpy(), view.cam_from_world.numpy())
        for n, view in enumerate(views)
    ]
    return Capture(Path(), Frames.of(frames), {})


def test_neighbours_are_frames_that_see_the_same_from_elsewhere() -> None:
    behind = view_of(
        torch.ones(SIZE), looking_at(torch.tensor([0.0, 0, -5]).double(), torch.zeros(3).double())
    )
    views = [wall(2.0), wall(2.0, x=0.001), wall(2.0, x=0.25), wall(2.0, x=-0.25), behind]
    others = np.arange(1, 5)
    assert set(neighbours(views[0], captured(views).frames, others, 2)) == {2, 3}
    assert set(neighbours(views[0], captured(views).frames, others, 9)) == {1, 2, 3}
    assert neighbours(view_of(torch.zeros(SIZE)), captured(views).frames, others, 2) == []
