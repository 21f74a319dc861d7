"""Maps that are held to what a sensor measured."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from deltas_nets.agree.held import held
from deltas_nets.network.known_depth import KnownDepth

SIZE = (24, 32)


def wave(scale: float = 1.0) -> Tensor:
    """Depth ``(1, H, W)`` that differs from pixel to pixel."""
    rows, columns = torch.meshgrid(*map(torch.arange, SIZE), indexing="ij")
    return scale * (2 + 0.2 * torch.sin(rows / 5) + 0.2 * torch.cos(columns / 7))[None]


def sure(depth: Tensor, deviation: float) -> KnownDepth:
    return KnownDepth(depth, torch.full_like(depth, deviation))


def some(depth: Tensor, count: int, seed: int) -> Tensor:
    """Depth at so many pixels, 0 elsewhere."""
    kept = np.random.default_rng(seed).choice(depth.numel(), count, replace=False)
    found = torch.zeros(depth.numel())
    found[kept] = depth.flatten()[kept]
    return found.view(depth.shape)


@given(seed=st.integers(0, 1000), count=st.integers(0, 400))
def test_what_was_measured_as_it_is_changes_no_depth(seed: int, count: int) -> None:
    found = held(sure(wave(), 0.03), sure(some(wave(), count, seed), 0.02))
    assert_close(found.depth, wave(), rtol=1e-4, atol=0)
    assert (found.deviation <= 0.03).all() and (found.deviation < 0.017).sum() == count


@given(scale=st.floats(0.7, 1.4), seed=st.integers(0, 1000))
def test_a_whole_sensor_has_the_last_word(scale: float, seed: int) -> None:
    measured = sure(wave(scale), 0.001)
    found = held(sure(wave(), 0.01), measured)
    assert_close(found.depth, measured.depth, rtol=0.01, atol=0)
    assert found.deviation.max() <= 0.001


@pytest.mark.parametrize("count", [60, 200])
def test_points_move_the_rest_of_a_map(count: int) -> None:
    found = held(sure(wave(), 0.03), sure(some(wave(1.05), count, 0), 0.01))
    off = (found.depth / wave(1.05)).log().abs()
    assert off.mean() < 0.25 * np.log(1.05)


@pytest.mark.parametrize("wrong", [0.3, 3.0])
def test_lone_measurements_that_contradict_the_map_are_not_believed(wrong: float) -> None:
    lone = torch.zeros(1, *SIZE)
    lone[:, 3::7, 3::7] = wrong * wave()[:, 3::7, 3::7]
    found = held(sure(wave(), 0.03), sure(lone, 0.02))
    assert_close(found.depth, wave())
    assert_close(found.deviation, torch.full_like(wave(), 0.03))


def test_a_surface_that_was_measured_is_there_whatever_the_map_says() -> None:
    thing = torch.zeros(1, *SIZE)
    thing[:, 5:10, 20:25] = 1.2
    found = held(sure(wave(), 0.01), sure(thing, 0.02))
    assert_close(found.depth[thing > 0], thing[thing > 0], rtol=0.02, atol=0)


@pytest.mark.parametrize("unknown", ["map", "sensor"])
def test_without_either_nothing_changes(unknown: str) -> None:
    nothing = sure(torch.zeros(1, *SIZE), 0.02)
    own, measured = sure(wave(), 0.03), sure(wave(1.1), 0.02)
    if unknown == "map":
        assert_close(held(nothing, measured), nothing)
    else:
        assert_close(held(own, nothing), own)
