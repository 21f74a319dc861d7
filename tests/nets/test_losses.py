"""Losses: zero for the truth, larger for worse, finite always."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.losses import inverse_depth_smoothness_loss
from torch.nn.functional import binary_cross_entropy

from deltas_geom import Matches, PosedViews, triangulate
from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.config import (
    PAPER_LOSS,
    TRAIN_CONFIGS,
    DetectorConfig,
    LossConfig,
    MatcherConfig,
    NetworkConfig,
    to_dict,
)
from deltas_nets.losses.dense import depth_loss, gradient_loss, smoothness_loss, spread_loss
from deltas_nets.losses.losses import loss_functions, training_losses
from deltas_nets.losses.points import confidence_loss, match_loss, point_loss, posterior_loss
from deltas_nets.losses.seen import MapAlone, Seen
from deltas_nets.losses.targets import Targets, detector_labels, keypoint_targets
from deltas_nets.network.deltas import Deltas
from deltas_nets.network.lite.densifier import DenseDepth
from deltas_nets.network.prediction import DepthPrediction
from deltas_nets.network.records import Posterior
from deltas_nets.rooms import render_room

RANGE = (0.5, 10.0)


@pytest.fixture(scope="module")
def room() -> PosedImages:
    room = render_room(6, num_views=3, image_size=(64, 96))
    batched = [tensor[None] for tensor in room.views]
    return PosedImages(room.images[None].float() / 255, PosedViews(*batched), room.depth[None])


@pytest.fixture(scope="module")
def prediction(room: PosedImages) -> DepthPrediction:
    with torch.no_grad():
        found: DepthPrediction = Deltas(NetworkConfig()).eval()(room.images, room.views)
    return found


@pytest.fixture(scope="module")
def seen(room: PosedImages, prediction: DepthPrediction) -> Seen:
    keypoints = torch.cartesian_prod(torch.arange(4.0, 96, 9), torch.arange(4.0, 64, 9))[None]
    targets = keypoint_targets(room.views, room.depth, keypoints, depth_range=RANGE)
    image = room.images[:, 0]
    labels = detector_labels(image)
    return Seen(prediction, image, room.depth[:, :1], targets, labels, RANGE, decay=0.7)


def with_matches(seen: Seen, matches: Matches) -> Seen:
    return seen._replace(prediction=seen.prediction._replace(matches=matches))


def with_dense(seen: Seen, log_depth: torch.Tensor, log_spread: float = -3.0) -> Seen:
    scales = [
        torch.nn.functional.adaptive_avg_pool2d(log_depth, (64 // s, 96 // s))
        for s in (1, 4, 8, 16)
    ]
    spread = torch.full((1, 1, 64, 96), log_spread)
    evidence = seen.prediction.evidence._replace(dense=DenseDepth(tuple(scales), spread))
    return seen._replace(prediction=seen.prediction._replace(evidence=evidence))


def test_the_table_names_functions_and_the_papers_weights() -> None:
    terms = [name for name in to_dict(LossConfig()) if name != "scale_decay"]
    assert list(loss_functions()) == terms
    of_the_paper = {"detector": 0.1, "match": 1.0, "point": 2.0, "smoothness": 1.0, "depth": 2.0}
    others = dict.fromkeys(terms[len(of_the_paper) :], 0.0)
    assert to_dict(PAPER_LOSS) == {**of_the_paper, "scale_decay": 0.7, **others}
    for name in ("deltas-resnet50", "deltas-vgg9"):
        assert to_dict(TRAIN_CONFIGS[name].loss) == {**to_dict(PAPER_LOSS), "spread": 0.1}


def true_matches(targets: Targets) -> Matches:
    seen = targets.visible
    zeros = torch.zeros(*seen.shape, 2, 2)
    return Matches(targets.pixels, torch.ones(seen.shape), zeros, seen)


def test_true_matches_and_points_cost_nothing(room: PosedImages, seen: Seen) -> None:
    matches = true_matches(seen.targets)
    assert match_loss(with_matches(seen, matches)) == 0
    points = triangulate(room.views.proj, matches.pixels, matches.weights, matches.mask)
    assert points.valid.any()
    assert point_loss(seen._replace(prediction=seen.prediction._replace(points=points))) < 1e-5


@given(shift=st.floats(0.1, 2.0))
def test_a_larger_shift_of_the_matches_costs_more(seen: Seen, shift: float) -> None:
    matches = true_matches(seen.targets)
    near = matches._replace(pixels=matches.pixels + shift)
    far = matches._replace(pixels=matches.pixels + 1.2 * shift)
    assert 0 < match_loss(with_matches(seen, near)) < match_loss(with_matches(seen, far))


def test_matches_elsewhere_altogether_pull_at_nothing(seen: Seen) -> None:
    matches = true_matches(seen.targets)
    pixels = (matches.pixels + 50).requires_grad_()
    match_loss(with_matches(seen, matches._replace(pixels=pixels))).backward()
    assert pixels.grad is not None
    assert (pixels.grad == 0).all()


def test_true_depth_costs_less_than_any_other(seen: Seen) -> None:
    truth, wrong = (depth_loss(with_dense(seen, seen.depth.log() + by)) for by in (0, 0.2))
    assert truth < 0.3 * wrong


def test_edges_elsewhere_cost_and_a_constant_factor_does_not(seen: Seen) -> None:
    truth, factor, moved = (
        gradient_loss(with_dense(seen, log_depth))
        for log_depth in (seen.depth.log(), seen.depth.log() + 0.2, seen.depth.log().roll(8, -1))
    )
    torch.testing.assert_close(truth, factor, rtol=1e-4, atol=1e-5)
    assert truth < 0.5 * moved


@pytest.mark.parametrize("loss", [depth_loss, gradient_loss, spread_loss])
def test_unknown_depth_counts_nowhere(seen: Seen, loss: Callable[[Seen], torch.Tensor]) -> None:
    nothing = torch.zeros_like(seen.depth)
    assert loss(with_dense(seen._replace(depth=nothing), torch.ones_like(nothing))) == 0


def test_where_known_depth_ends_is_no_edge(seen: Seen) -> None:
    depth = torch.full((1, 1, 64, 96), 3.0)
    log_depth = depth.log()
    depth[..., 20:40], depth[..., 16:32, :] = 0, 0
    assert gradient_loss(with_dense(seen._replace(depth=depth), log_depth)) < 1e-5


def test_cells_of_which_little_is_known_count_at_no_coarser_scale(seen: Seen) -> None:
    depth = torch.zeros(1, 1, 64, 96)
    depth[..., ::2, ::4] = 3.0
    wrong = with_dense(seen._replace(depth=depth), torch.full_like(depth, 3.0).log() + 0.2)
    assert float(depth_loss(wrong)) == pytest.approx(0.2 - 0.02 / 2, rel=1e-4)  # of the finest


def test_doubt_does_not_pull_at_depth(seen: Seen) -> None:
    log_depth = seen.depth.log().add(0.1).requires_grad_(True)
    assert not spread_loss(with_dense(seen, log_depth)).requires_grad
    assert depth_loss(with_dense(seen, log_depth)).requires_grad


@given(error=st.floats(0.01, 0.3))
def test_the_likeliest_spread_is_the_mean_absolute_error(seen: Seen, error: float) -> None:
    depth = torch.full((1, 1, 64, 96), 3.0)
    wrong = seen._replace(depth=depth)
    less, right, more = (
        spread_loss(with_dense(wrong, depth.log() + error, math.log(error * factor)))
        for factor in (0.7, 1.0, 1.4)
    )
    assert right < min(less, more)


def test_the_right_posterior_costs_less(seen: Seen) -> None:
    targets = seen.targets
    inv_depth = torch.linspace(0.1, 2.0, 64)
    inverse = 1 / targets.depth.clamp_min(0.1)
    right = -((inv_depth - inverse[:, None, :, None]) / 0.03).square() / 2
    mask = torch.ones_like(right, dtype=torch.bool)

    def cost(*stages: torch.Tensor) -> float:
        posterior = Posterior(stages, inv_depth, mask)
        evidence = seen.prediction.evidence._replace(posterior=posterior)
        return float(
            posterior_loss(seen._replace(prediction=seen.prediction._replace(evidence=evidence)))
        )

    assert cost(right) < cost(torch.zeros_like(right)) < cost(right.flip(-1))
    # The first and the last stage count in full.
    assert cost(right, right, right) == pytest.approx(2.7 * cost(right))


def test_smoothness_is_kornias_of_relative_inverse_depth(seen: Seen) -> None:
    random = torch.Generator().manual_seed(0)
    depth = 1 + torch.rand(2, 1, 12, 16, generator=random)
    image = torch.rand(2, 3, 12, 16, generator=random)
    inverse = 1 / depth
    expected = inverse_depth_smoothness_loss(
        inverse / inverse.mean(dim=(2, 3), keepdim=True), image
    )
    for factor in (1, 5):
        dense = seen.dense._replace(log_depth=((factor * depth).log(),))
        found = smoothness_loss(MapAlone(dense, image, depth, RANGE, 1.0))
        torch.testing.assert_close(found, expected)


def test_kornias_smoothness_spares_edges_of_the_image() -> None:
    step = torch.ones(1, 1, 8, 8)
    step[..., 4:] = 2.0
    flat, edge = torch.zeros(1, 3, 8, 8), step.expand(1, 3, 8, 8)
    assert inverse_depth_smoothness_loss(step, edge) < inverse_depth_smoothness_loss(step, flat)


def test_confidence_costs_its_cross_entropy_and_hands_nan_on(
    room: PosedImages, seen: Seen, prediction: DepthPrediction
) -> None:
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
        right_or_not = prediction._replace(evidence=evidence)
        return confidence_loss(seen._replace(prediction=right_or_not, targets=targets))

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
    assert all(term.isfinite() for term in losses.terms.values())
    assert all(term >= 0 for name, term in losses.terms.items() if name != "spread")
    losses.total.backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in model.parameters())
