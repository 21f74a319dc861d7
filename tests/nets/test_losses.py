"""Losses: zero for the truth, larger for worse, finite always."""

from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.losses import inverse_depth_smoothness_loss
from torch.nn.functional import binary_cross_entropy

from deltas_geom import Matches, PosedViews, triangulate
from deltas_nets.config import DetectorConfig, LossConfig, MatcherConfig, NetworkConfig
from deltas_nets.datasets.posed_images import PosedImages
from deltas_nets.losses.losses import (
    confidence_loss,
    depth_terms,
    match_loss,
    point_loss,
    posterior_loss,
    smoothness_loss,
    spread_loss,
    training_losses,
)
from deltas_nets.losses.targets import Targets, keypoint_targets
from deltas_nets.network.deltas import Deltas
from deltas_nets.network.lite.densifier import DenseDepth
from deltas_nets.network.records import Posterior
from deltas_nets.rooms import render_room

RANGE = (0.5, 10.0)


@pytest.fixture(scope="module")
def room() -> PosedImages:
    room = render_room(6, num_views=3, image_size=(64, 96))
    batched = [tensor[None] for tensor in room.views]
    return PosedImages(room.images[None].float() / 255, PosedViews(*batched), room.depth[None])


@pytest.fixture(scope="module")
def targets(room: PosedImages) -> Targets:
    keypoints = torch.cartesian_prod(torch.arange(4.0, 96, 9), torch.arange(4.0, 64, 9))[None]
    return keypoint_targets(room.views, room.depth, keypoints, depth_range=RANGE)


def true_matches(targets: Targets) -> Matches:
    seen = targets.visible
    zeros = torch.zeros(*seen.shape, 2, 2)
    return Matches(targets.pixels, torch.ones(seen.shape), zeros, seen)


def dense(log_depth: torch.Tensor, log_spread: float = -3.0) -> DenseDepth:
    scales = [
        torch.nn.functional.adaptive_avg_pool2d(log_depth, (64 // s, 96 // s))
        for s in (1, 4, 8, 16)
    ]
    return DenseDepth(tuple(scales), torch.full((1, 1, 64, 96), log_spread))


def test_true_matches_and_points_cost_nothing(room: PosedImages, targets: Targets) -> None:
    matches = true_matches(targets)
    assert match_loss(matches, targets) == 0
    points = triangulate(room.views.proj, matches.pixels, matches.weights, matches.mask)
    assert points.valid.any()
    assert point_loss(points, targets) < 1e-5


@given(shift=st.floats(0.1, 2.0))
def test_a_larger_shift_of_the_matches_costs_more(
    room: PosedImages, targets: Targets, shift: float
) -> None:
    matches = true_matches(targets)
    near = matches._replace(pixels=matches.pixels + shift)
    far = matches._replace(pixels=matches.pixels + 1.2 * shift)
    assert 0 < match_loss(near, targets) < match_loss(far, targets)


def test_matches_elsewhere_altogether_pull_at_nothing(targets: Targets) -> None:
    matches = true_matches(targets)
    pixels = (matches.pixels + 50).requires_grad_()
    match_loss(matches._replace(pixels=pixels), targets).backward()
    assert pixels.grad is not None
    assert (pixels.grad == 0).all()


def test_true_depth_costs_less_than_any_other(room: PosedImages) -> None:
    depth = room.depth[:, :1]
    truth, _ = depth_terms(dense(depth.log()), depth, depth_range=RANGE, decay=0.7)
    wrong, _ = depth_terms(dense(depth.log() + 0.2), depth, depth_range=RANGE, decay=0.7)
    assert truth < 0.3 * wrong


def test_unknown_depth_counts_nowhere(room: PosedImages) -> None:
    nothing = torch.zeros_like(room.depth[:, :1])
    value, gradient = depth_terms(
        dense(torch.ones_like(nothing)), nothing, depth_range=RANGE, decay=0.7
    )
    assert value == 0
    assert gradient == 0
    assert spread_loss(dense(torch.ones_like(nothing)), nothing, depth_range=RANGE) == 0


@given(error=st.floats(0.01, 0.3))
def test_the_likeliest_spread_is_the_mean_absolute_error(error: float) -> None:
    depth = torch.full((1, 1, 64, 96), 3.0)
    costs = [
        float(
            spread_loss(
                dense(depth.log() + error, float(torch.tensor(error * factor).log())),
                depth,
                depth_range=RANGE,
            )
        )
        for factor in (0.7, 1.0, 1.4)
    ]
    assert costs[1] < min(costs[0], costs[2])


def test_the_right_posterior_costs_less(targets: Targets) -> None:
    inv_depth = torch.linspace(0.1, 2.0, 64)
    inverse = 1 / targets.depth.clamp_min(0.1)
    right = -((inv_depth - inverse[:, None, :, None]) / 0.03).square() / 2
    mask = torch.ones_like(right, dtype=torch.bool)

    def cost(logits: torch.Tensor) -> float:
        return float(posterior_loss(Posterior((logits,), inv_depth, mask), targets))

    assert cost(right) < cost(torch.zeros_like(right)) < cost(right.flip(-1))


def test_smoothness_is_kornias_of_relative_inverse_depth() -> None:
    random = torch.Generator().manual_seed(0)
    depth = 1 + torch.rand(2, 1, 12, 16, generator=random)
    image = torch.rand(2, 3, 12, 16, generator=random)
    inverse = 1 / depth
    expected = inverse_depth_smoothness_loss(
        inverse / inverse.mean(dim=(2, 3), keepdim=True), image
    )
    torch.testing.assert_close(smoothness_loss(depth, image), expected)
    torch.testing.assert_close(smoothness_loss(5 * depth, image), expected)


def test_kornias_smoothness_spares_edges_of_the_image() -> None:
    step = torch.ones(1, 1, 8, 8)
    step[..., 4:] = 2.0
    flat, edge = torch.zeros(1, 3, 8, 8), step.expand(1, 3, 8, 8)
    assert inverse_depth_smoothness_loss(step, edge) < inverse_depth_smoothness_loss(step, flat)


def test_confidence_costs_its_cross_entropy_and_hands_nan_on(room: PosedImages) -> None:
    with torch.no_grad():
        prediction = Deltas(NetworkConfig()).eval()(room.images, room.views)
    pixels = prediction.keypoints.pixels
    targets = keypoint_targets(room.views, room.depth, pixels, depth_range=RANGE)
    factor = torch.linspace(0.9, 1.1, targets.depth.shape[-1])
    points = prediction.points
    depth = points.depth.clone()
    depth[:, 0] = factor * targets.depth
    valid = torch.arange(len(factor)) % 3 > 0
    prediction = prediction._replace(points=points._replace(depth=depth, valid=valid[None]))
    right = (((factor - 1).abs() < 0.05) & valid)[None]
    confidence = torch.linspace(0.01, 0.99, right.numel()).view_as(right)
    expected = binary_cross_entropy(
        confidence[targets.known], right[targets.known].to(confidence.dtype)
    )

    def cost(confidence: torch.Tensor) -> torch.Tensor:
        evidence = prediction.evidence._replace(confidence=confidence)
        return confidence_loss(prediction._replace(evidence=evidence), targets)

    torch.testing.assert_close(cost(confidence), expected)
    assert cost(confidence * torch.nan).isnan()


@pytest.mark.parametrize("kind", ["joint", "per_view"])
def test_all_terms_are_finite_and_differentiable(room: PosedImages, kind: Any) -> None:
    torch.manual_seed(0)
    config = NetworkConfig(
        detector=DetectorConfig(num_keypoints=64), matcher=MatcherConfig(kind=kind, num_samples=32)
    )
    model = Deltas(config)
    prediction = model(room.images, room.views)
    losses = training_losses(
        prediction, room.images, room.views, room.depth, LossConfig(), depth_range=RANGE
    )
    assert all(term.isfinite() for term in losses)
    assert all(
        term >= 0 for name, term in losses._asdict().items() if name not in ("spread", "total")
    )
    losses.total.backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in model.parameters())
