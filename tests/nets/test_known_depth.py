"""Measured depth: how it corrects the map and its points, and how it joins them."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import SparseDepth
from deltas_nets.network.correction import (
    LIKENESS,
    LOCAL,
    REACH,
    ROUGHNESS,
    SHARED,
    Places,
    correction,
)
from deltas_nets.network.known_depth import CELL, KnownDepth, as_points, joined, reconciled

SIZE = (24, 32)
ALL = SIZE[0] * SIZE[1]
seeds = st.integers(0, 1000)


def scene(seed: int, count: int, error: float = 0.03) -> tuple[Tensor, SparseDepth, Tensor]:
    """Log depth of a map, some known depths that differ from it, their variance; float64."""
    random = torch.Generator().manual_seed(seed)
    log_depth = 0.3 * torch.rand(1, 1, *SIZE, generator=random, dtype=torch.float64) + 0.5
    at = torch.randperm(SIZE[0] * SIZE[1], generator=random)[:count]
    off = error * torch.randn(count, generator=random, dtype=torch.float64)
    depth = torch.zeros(1, 1, *SIZE, dtype=torch.float64)
    depth.view(-1)[at] = (log_depth.view(-1)[at] + off).exp()
    variance = 1e-3 * torch.rand(1, 1, *SIZE, generator=random, dtype=torch.float64)
    return log_depth, SparseDepth(depth, (depth > 0).double()), variance


def everywhere(log_depth: Tensor) -> Places:
    return Places.at(torch.arange(log_depth[0].numel()).expand(len(log_depth), -1), log_depth)


@given(seeds, st.integers(1, 20))
def test_the_correction_is_that_of_a_gaussian_process(seed: int, count: int) -> None:
    log_depth, known, variance = scene(seed, count)
    process = correction(known, variance, log_depth, most=ALL)
    found = process(everywhere(log_depth))[0].numpy()
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]].reshape(2, -1)
    flat = log_depth.numpy().ravel()
    places = np.stack([columns, rows, flat], axis=-1) / (REACH * 32, REACH * 32, LIKENESS)
    at = known.weight.numpy().ravel() > 0
    squares = ((places[:, None] - places[None, at]) ** 2).sum(axis=-1)
    prior = SHARED**2 + LOCAL**2 * np.exp(-0.5 * squares)
    doubt = torch.ones(known.weight.numel(), dtype=torch.float64)
    doubt[process.places.pixels[0]] = process.doubt[0]
    noise = (variance.numpy().ravel()[at] + ROUGHNESS**2) * doubt.numpy()[at]
    off = np.log(known.depth.numpy().ravel()[at]) - flat[at]
    told = np.linalg.solve(prior[at] + np.diag(noise), np.column_stack([off, prior.T]))
    assert found == pytest.approx(prior @ told[:, 0], abs=1e-9)
    left = SHARED**2 + LOCAL**2 - np.einsum("pm,mp->p", prior, told[:, 1:])
    assert process.variance(everywhere(log_depth))[0].numpy() == pytest.approx(left, abs=1e-9)


@given(seeds, st.floats(0.7, 1.4))
def test_a_map_of_another_scale_is_set_right_by_many_depths(seed: int, scale: float) -> None:
    log_depth, _, variance = scene(seed, 1)
    known = SparseDepth(log_depth.exp() * scale, torch.ones_like(log_depth))
    found = correction(known, variance, log_depth)(everywhere(log_depth))
    assert_close(found, torch.full_like(found, np.log(scale)), rtol=0.1, atol=0.06)


@given(seeds)
def test_a_depth_that_contradicts_all_others_says_nothing(seed: int) -> None:
    log_depth, known, variance = scene(seed, 60, error=0.01)
    flat = known.depth.view(-1)
    places = (flat > 0).nonzero()[:, 0]
    wrong = int(places[seed % len(places)])
    without = known.weight.clone().view(-1).index_fill(0, torch.tensor(wrong), 0.0)
    others = SparseDepth(known.depth, without.view_as(known.weight))
    alone = correction(others, variance, log_depth, most=ALL)
    flat[wrong] *= 4
    process = correction(known, variance, log_depth, most=ALL)
    doubted = process.places.pixels[process.doubt > 100].tolist()
    assert doubted == [wrong]
    at = everywhere(log_depth)
    assert_close(process(at), alone(at), rtol=0, atol=0.02)
    believed = reconciled(
        SparseDepth(*(torch.zeros_like(part) for part in known)),
        KnownDepth(known.depth, torch.full_like(known.depth, 0.01)),
        log_depth,
    )
    weights = believed.weight.view(-1)
    assert weights[wrong] < 0.01 * weights.max()


def test_images_of_a_batch_do_not_hear_each_other() -> None:
    parts = [scene(seed, count) for seed, count in ((1, 3), (2, 17), (3, 1))]
    log_depth, variance = (torch.cat([part[i] for part in parts]) for i in (0, 2))
    known = SparseDepth(
        *(torch.cat(both) for both in zip(*(part[1] for part in parts), strict=True))
    )
    together = correction(known, variance, log_depth)(everywhere(log_depth))
    for number, (log, points, var) in enumerate(parts):
        alone = correction(points, var, log)(everywhere(log))
        assert_close(together[number], alone[0], rtol=1e-6, atol=1e-8)


@given(seeds)
def test_a_cell_has_one_point_the_surest(seed: int) -> None:
    random = torch.Generator().manual_seed(seed)
    depth = torch.rand(2, 1, 9, 14, generator=random) * (torch.rand(2, 1, 9, 14) < 0.4)
    deviation = torch.rand(2, 1, 9, 14, generator=random)
    points = as_points(KnownDepth(depth, deviation))
    for image in range(2):
        for row in range(0, 9, CELL):
            for column in range(0, 14, CELL):
                cell = image, 0, slice(row, row + CELL), slice(column, column + CELL)
                filled = points.weight[cell] > 0
                assert filled.sum() == (depth[cell] > 0).any()
                if filled.any():
                    assert deviation[cell][filled] == deviation[cell][depth[cell] > 0].min()
                    assert_close(points.depth[cell][filled], depth[cell][filled])


def test_what_is_no_depth_is_no_point() -> None:
    depth = torch.tensor([0.0, -1.0, torch.inf, torch.nan, 2.0, 2.0]).repeat_interleave(CELL)
    deviation = torch.tensor([0.1, 0.1, 0.1, 0.1, torch.nan, -1.0]).repeat_interleave(CELL)
    points = as_points(KnownDepth(depth[None, None, None], deviation[None, None, None]))
    assert not points.weight.any() and not points.depth.any()


@given(seeds)
def test_joined_points_are_means_by_weight(seed: int) -> None:
    random = torch.Generator().manual_seed(seed)
    weights = torch.rand(2, 1, 1, 4, 5, generator=random) * (torch.rand(2, 1, 1, 4, 5) < 0.6)
    depths = torch.rand(2, 1, 1, 4, 5, generator=random) + 1
    one, other = (SparseDepth(d * (w > 0), w) for d, w in zip(depths, weights, strict=True))
    both = joined(one, other)
    assert_close(both.weight, weights.sum(dim=0))
    assert_close(both.depth * both.weight, (depths * weights).sum(dim=0))


def test_depth_that_is_the_maps_own_moves_no_point() -> None:
    log_depth, matched, _ = scene(4, 40)
    own = KnownDepth(log_depth.exp(), torch.full_like(log_depth, 0.01))
    found = reconciled(matched, own, log_depth)
    alone = (matched.weight > 0) & (as_points(own).weight == 0)
    assert_close(found.depth[alone], matched.depth[alone])
