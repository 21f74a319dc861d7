"""Soft-argmax, and matches of both kinds."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import (
    ShapeError,
    epipolar_segments,
    match_joint,
    match_per_view,
    sample_inv_depths,
    sample_segments,
    soft_argmax,
    triangulate,
    weights_from_covariance,
)
from deltas_geom.testing import PosedScene, forward_motion, seeded_scene
from deltas_geom.testing.scenes import IMAGE_SIZE
from deltas_geom.testing.strategies import extreme, posed_scenes, vectors

INV_DEPTHS = torch.linspace(0.05, 0.8, 31, dtype=torch.float64)  # 1/m


def test_wrong_arguments_are_named() -> None:
    with pytest.raises(ShapeError, match="positions has S = 3 but logits has S = 2"):
        soft_argmax(torch.zeros(2), torch.zeros(3, 1))
    segments = epipolar_segments(
        forward_motion().views, torch.zeros(5, 2).double(), depth_range=(1, 2), image_size=(9, 9)
    )
    samples = sample_segments(segments, 4, offsets=(0, 1))
    with pytest.raises(ValueError, match="without offsets"):
        match_per_view(torch.zeros(5, 2), samples.pixels[..., 0], samples, window=1)


def test_scores_of_other_samples_are_named() -> None:
    views, _, pixels = seeded_scene(0, num_views=3, num_points=4)
    samples = sample_inv_depths(views, pixels[0], INV_DEPTHS, image_size=IMAGE_SIZE)
    # One source's scores for both would broadcast, and be believed.
    for shape, told in (
        ((1, 4, 1, 31), "samples has sources = 2 but scores has sources = 1"),
        ((2, 4, 1, 30), "samples has S = 31 but scores has S = 30"),
        ((2, 3, 1, 31), "scores has N = 3 but keypoints has N = 4"),
    ):
        scores = torch.zeros(shape).double()
        with pytest.raises(ShapeError, match=told):
            match_per_view(pixels[0], scores, samples)
        with pytest.raises(ShapeError, match=told):
            match_joint(views, pixels[0], scores, samples, image_size=IMAGE_SIZE)
    with pytest.raises(ShapeError, match="samples has N = 4 but keypoints has N = 1"):
        match_per_view(pixels[0, :1], torch.zeros(2, 1, 1, 31).double(), samples)
    none = samples._replace(
        pixels=samples.pixels[:0], inv_depth=samples.inv_depth[:0], mask=samples.mask[:0]
    )
    with pytest.raises(ShapeError, match="scores must have sources >= 1"):
        match_joint(views, pixels[0], torch.zeros(0, 4, 1, 31), none, image_size=IMAGE_SIZE)


def test_wrong_covariances_and_floors_are_named() -> None:
    with pytest.raises(ShapeError, match="covariance must have shape"):
        weights_from_covariance(torch.zeros(4, 2))
    for floor in (0.0, -1.0, torch.nan):
        with pytest.raises(ValueError, match="floor must be positive"):
            weights_from_covariance(torch.zeros(4, 2, 2), floor=floor)


@given(positions=vectors(7, within=100.0, size=2), place=st.integers(0, 6))
def test_the_soft_argmax_of_a_delta_is_the_delta(positions: Tensor, place: int) -> None:
    logits = torch.zeros(7, dtype=torch.float64)
    logits[place] = 1000.0
    for window in (None, 0, 2):
        found = soft_argmax(logits, positions, window=window)
        assert_close(found.position, positions[place], rtol=0, atol=1e-12)
        assert found.peak == 1 and found.mass == 1 and found.entropy == 0
        assert (found.covariance == 0).all()


@given(
    logits=vectors(1, within=5.0, size=7),
    positions=vectors(7, within=10.0, size=2),
    shift=vectors(1, within=100.0, size=2),
    constant=st.floats(-100, 100),
)
def test_soft_argmax_is_shift_equivariant(
    logits: Tensor, positions: Tensor, shift: Tensor, constant: float
) -> None:
    found = soft_argmax(logits[0], positions)
    moved = soft_argmax(logits[0] + constant, positions + shift)
    assert_close(moved.position, found.position + shift[0], rtol=0, atol=1e-10)
    assert_close(moved.covariance, found.covariance, rtol=0, atol=1e-9)
    assert_close(moved.entropy, found.entropy, rtol=0, atol=1e-10)
    wanted = torch.distributions.Categorical(logits=logits[0]).entropy()
    assert_close(found.entropy, wanted, rtol=0, atol=1e-12)


@given(left=vectors(1, within=1.0, size=3), positions=vectors(7, within=10.0, size=2))
def test_a_window_leaves_the_other_mode_out(left: Tensor, positions: Tensor) -> None:
    logits = torch.cat([left[0] + 5, torch.zeros(1), left[0]])  # a second mode of e^-5
    found = soft_argmax(logits, positions, window=2)
    alone = soft_argmax(logits, positions)
    peak = int(logits.argmax())
    near = slice(max(0, peak - 2), peak + 3)
    windowed = soft_argmax(logits[near], positions[near])
    assert_close(found.position, windowed.position, rtol=0, atol=1e-12)
    assert_close(found.covariance, windowed.covariance, rtol=0, atol=1e-10)
    assert_close(found.mass, logits.softmax(-1)[near].sum(), rtol=0, atol=1e-12)
    assert_close(found.peak, alone.peak, rtol=0, atol=0)
    assert_close(found.entropy, alone.entropy, rtol=0, atol=0)


@given(logits=vectors(1, within=5.0, size=7), positions=vectors(7, within=10.0, size=2))
def test_what_is_masked_may_hold_anything(logits: Tensor, positions: Tensor) -> None:
    mask = torch.tensor([True, False, True, True, True, True, False])
    found = soft_argmax(logits[0][mask], positions[mask])
    spoilt = logits[0].masked_fill(~mask, torch.nan).requires_grad_()
    places = positions.masked_fill(~mask[:, None], torch.nan).requires_grad_()
    masked = soft_argmax(spoilt, places, mask=mask)
    for ours, wanted in zip(masked, found, strict=True):
        assert_close(ours, wanted, rtol=0, atol=1e-12)
    for gradient in torch.autograd.grad(masked.position.sum() + masked.entropy, (spoilt, places)):
        assert gradient.isfinite().all() and (gradient[~mask] == 0).all()


@given(logits=extreme(5), positions=extreme(5, 2, decades=15))
def test_no_finite_logit_gives_nan_or_inf(logits: Tensor, positions: Tensor) -> None:
    for dtype in (torch.float32, torch.float64):
        scores = logits.to(dtype).requires_grad_()
        for mask in (None, torch.zeros(5, dtype=torch.bool)):
            for window in (None, 1):
                found = soft_argmax(scores, positions.to(dtype), mask=mask, window=window)
                assert all(value.isfinite().all() for value in found)
                total = found.position.sum() + found.peak + found.mass + found.entropy
                assert torch.autograd.grad(total, scores)[0].isfinite().all()


@given(scene=posed_scenes(num_views=3), place=st.integers(2, 28))
def test_joint_matches_triangulate_to_the_depth_that_all_views_prefer(
    scene: PosedScene, place: int
) -> None:
    samples = sample_inv_depths(scene.views, scene.pixels[0], INV_DEPTHS, image_size=IMAGE_SIZE)
    scores = torch.zeros(2, 4, 1, 31, dtype=torch.float64)
    scores[..., place] = 1000.0
    matches = match_joint(scene.views, scene.pixels[0], scores, samples, image_size=IMAGE_SIZE)
    both = samples.mask[:, :, 0, place]
    anyone = both.any(dim=0)  # where no view sees the place, the decision falls elsewhere
    assert ((matches.mask[1:] == both) | ~anyone).all()
    found = triangulate(scene.views.proj, matches.pixels, matches.weights, matches.mask)
    depth = torch.where(anyone, found.depth[0], 1 / INV_DEPTHS[place])
    assert_close(depth, (1 / INV_DEPTHS[place]).expand(4), rtol=1e-9, atol=0)
    assert found.valid[anyone].all()


def test_joint_matches_take_inverse_depths_of_all_sources_alone() -> None:
    views, _, pixels = seeded_scene(0, num_views=3, num_points=4)
    segments = epipolar_segments(views, pixels[0], depth_range=(0.1, 100.0), image_size=IMAGE_SIZE)
    samples = sample_segments(segments, 8)
    with pytest.raises(ValueError, match="use sample_inv_depths"):
        match_joint(views, pixels[0], torch.zeros(2, 4, 1, 8), samples, image_size=IMAGE_SIZE)


@given(scene=posed_scenes(num_views=3), scores=vectors(2, within=3.0, size=4 * 31))
def test_a_joint_score_is_the_mean_over_the_views_that_see_the_sample(
    scene: PosedScene, scores: Tensor
) -> None:
    samples = sample_inv_depths(scene.views, scene.pixels[0], INV_DEPTHS, image_size=IMAGE_SIZE)
    hidden = torch.arange(31) % 3 == 0  # from the second source
    samples.mask[1, ..., hidden] = False
    scores, seen = scores.reshape(2, 4, 1, 31), samples.mask
    mean = torch.where(seen, scores, 0.0).sum(dim=0) / seen.sum(dim=0).clamp(min=1)
    wild = torch.where(seen, scores, 50.0)
    found, wanted = (
        match_joint(scene.views, scene.pixels[0], each, samples, image_size=IMAGE_SIZE)
        for each in (wild, mean.expand(2, 4, 1, 31))
    )
    assert_close(tuple(found), tuple(wanted), rtol=0, atol=1e-9)  # px


@given(scene=posed_scenes(num_views=3), place=st.integers(0, 30))
def test_a_match_of_one_view_is_its_best_sample(scene: PosedScene, place: int) -> None:
    samples = sample_inv_depths(scene.views, scene.pixels[0], INV_DEPTHS, image_size=IMAGE_SIZE)
    scores = torch.zeros(2, 4, 1, 31, dtype=torch.float64)
    scores[..., place] = 1000.0
    matches = match_per_view(scene.pixels[0], scores, samples)
    seen = samples.mask[:, :, 0, place]
    offset = matches.pixels[1:] - samples.pixels[:, :, 0, place]
    offset = torch.where(seen[..., None], offset, 0.0)
    assert_close(offset, torch.zeros_like(offset), rtol=0, atol=1e-9)  # px
    assert (matches.weights[1:][seen] == 1).all()
    assert_close(matches.pixels[0], scene.pixels[0], rtol=0, atol=0)
    assert (matches.weights[0] == 1).all() and (matches.covariance[0] == 0).all()


@given(spread=vectors(3, within=8.0, size=4), turn=st.floats(-3, 3), floor=st.floats(0.1, 4))
def test_weights_do_not_know_how_the_image_is_turned(
    spread: Tensor, turn: float, floor: float
) -> None:
    root = spread.reshape(3, 2, 2)
    covariance = root @ root.mT  # px^2
    c, s = math.cos(turn), math.sin(turn)
    rotation = torch.tensor([[c, -s], [s, c]], dtype=torch.float64)
    weights = weights_from_covariance(covariance, floor=floor)
    turned = weights_from_covariance(rotation @ covariance @ rotation.mT, floor=floor)
    assert_close(turned, weights, rtol=1e-12, atol=0)
    variance = covariance.diagonal(dim1=-2, dim2=-1).mean(dim=-1) + floor**2
    assert_close(weights.square().reciprocal(), variance, rtol=1e-12, atol=0)
    assert ((weights > 0) & (weights <= 1 / floor * (1 + 1e-12))).all()


def test_with_weights_in_1_per_px_the_covariance_of_points_is_that_of_the_noise() -> None:
    generator = torch.Generator().manual_seed(0)
    proj = torch.eye(3, 4, dtype=torch.float64).repeat(3, 1, 1)
    proj[:, :2, :2] *= 500
    proj[1:, 0, 3] = 500 * torch.tensor([-0.4, 0.4])  # m to either side
    pixels = torch.tensor([[0.0, 0], [-100, 0], [100, 0]]).double()[:, None]  # 2 m ahead
    deviation = torch.tensor([0.5, 0.8, 1.2]).double()  # px
    noise = torch.randn(3, 20_000, 2, generator=generator, dtype=torch.float64)
    seen = pixels + deviation[:, None, None] * noise
    floor = 0.5
    spread = (deviation**2 - floor**2)[:, None, None] * torch.eye(2, dtype=torch.float64)
    weights = weights_from_covariance(spread, floor=floor)[:, None]
    stated = triangulate(proj, pixels, weights, covariance=True).covariance
    points = triangulate(proj, seen, weights.expand(3, 20_000)).points
    assert stated is not None
    # 20 000 draws know a standard deviation to 0.5 %; the expansion is of first order.
    found = points.std(dim=0)
    assert_close(found, stated[0].diagonal().sqrt(), rtol=0.02, atol=0)


@given(covariance=extreme(4, 2, 2))
def test_no_covariance_gives_a_weight_that_is_nan_or_inf(covariance: Tensor) -> None:
    for dtype in (torch.float32, torch.float64):
        spread = covariance.to(dtype).requires_grad_()
        weights = weights_from_covariance(spread)
        assert weights.isfinite().all() and (weights >= 0).all()
        assert torch.autograd.grad(weights.sum(), spread)[0].isfinite().all()
    spoilt = torch.tensor([torch.nan, torch.inf, -torch.inf, -1.0])[:, None, None].expand(4, 2, 2)
    spoilt = spoilt.clone().requires_grad_()
    weights = weights_from_covariance(spoilt)
    assert (weights == 0).all()
    assert (torch.autograd.grad(weights.sum(), spoilt)[0] == 0).all()


def test_a_match_without_variance_weighs_one_by_the_floor(dtype: torch.dtype) -> None:
    scene = forward_motion(dtype=dtype)
    samples = sample_inv_depths(
        scene.views, scene.pixels[0], INV_DEPTHS.to(dtype), image_size=IMAGE_SIZE
    )
    scores = torch.zeros(1, 3, 1, 31, dtype=dtype)
    matches = match_per_view(scene.pixels[0], scores, samples)
    weights = weights_from_covariance(matches.covariance, floor=0.25)
    assert weights.shape == matches.weights.shape and weights.dtype == dtype
    assert (weights[0] == 4).all() and (weights[1] < 4).all()


def test_gradients_are_right() -> None:
    generator = torch.Generator().manual_seed(0)

    def random(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64).requires_grad_()

    mask = torch.tensor([True, True, False, True, True])
    for window in (None, 1):

        def moments(
            logits: Tensor, positions: Tensor, window: int | None = window
        ) -> tuple[Tensor, ...]:
            return tuple(soft_argmax(logits, positions, mask=mask, window=window))

        assert torch.autograd.gradcheck(moments, (random(5), random(5, 2)))
