"""Scores that are not finite: -inf, the usual mark of what is masked, and any other."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from operations import SIZE, at_depths, inputs_in
from torch import Tensor

from deltas_geom import PosedViews, match_joint, match_per_view, soft_argmax
from deltas_geom.testing.strategies import vectors

LEFT_OUT = (-torch.inf, torch.inf, torch.nan)


@given(
    logits=vectors(1, within=5.0, size=7),
    positions=vectors(7, within=10.0, size=2),
    mask=st.lists(st.booleans(), min_size=7, max_size=7),
    value=st.sampled_from(LEFT_OUT),
    window=st.sampled_from([None, 0, 2]),
)
def test_a_logit_that_is_not_finite_is_a_masked_place(
    logits: Tensor, positions: Tensor, mask: list[bool], value: float, window: int | None
) -> None:
    kept = torch.tensor(mask)
    wanted = soft_argmax(logits[0], positions, mask=kept, window=window)
    marked = logits[0].masked_fill(~kept, value).requires_grad_()
    found = soft_argmax(marked, positions, window=window)
    for ours, theirs in zip(found, wanted, strict=True):
        assert torch.equal(ours, theirs) and ours.isfinite().all()
    total = found.position.sum() + found.peak + found.mass + found.entropy
    (gradient,) = torch.autograd.grad(total + found.covariance.sum(), marked)
    assert gradient.isfinite().all() and (gradient[~kept] == 0).all()


def test_the_least_of_logits_is_not_masked_for_another() -> None:
    logits = torch.tensor([-3e38, -2e38, 0.0])
    found = soft_argmax(logits, torch.arange(3.0)[:, None], mask=torch.tensor([True, True, False]))
    assert found.position.item() == 1 and found.peak == 1


@pytest.mark.parametrize("value", LEFT_OUT)
def test_scores_that_are_not_finite_are_samples_not_seen(value: float) -> None:
    inputs = inputs_in(torch.float64)
    K, poses, keypoints = (inputs[name] for name in ("K", "poses", "keypoints"))
    views, samples = PosedViews(K, poses), at_depths(K, poses, keypoints, inputs["inv_depths"])
    assert samples.mask.shape[0] == 2 and (samples.mask.sum(dim=0) == 2).any()
    generator = torch.Generator().manual_seed(0)
    scores = torch.rand(samples.mask.shape, generator=generator, dtype=torch.float64)
    kept = torch.rand(samples.mask.shape, generator=generator) > 0.3
    kept[0, 0], kept[:, 1] = False, False  # nothing in one source, nothing in any
    masked = samples._replace(mask=samples.mask & kept)
    marked = scores.masked_fill(~kept, value).requires_grad_()
    for found, wanted in (
        (
            match_per_view(keypoints, marked, samples),
            match_per_view(keypoints, scores, masked),
        ),
        (
            match_joint(views, keypoints, marked, samples, image_size=SIZE),
            match_joint(views, keypoints, scores, masked, image_size=SIZE),
        ),
    ):
        for ours, theirs in zip(found, wanted, strict=True):
            assert torch.equal(ours, theirs)
        assert (found.weights[1:, 1] == 0).all()
        (gradient,) = torch.autograd.grad(found.pixels.sum() + found.weights.sum(), marked)
        assert gradient.isfinite().all() and (gradient[~kept] == 0).all()
    alone = match_per_view(keypoints, marked, samples)
    assert not alone.mask[1, 0] and not alone.mask[1:, 1].any()


def test_a_window_is_not_negative() -> None:
    with pytest.raises(ValueError, match="window must be 0 or more, got -1"):
        soft_argmax(torch.zeros(3), torch.zeros(3, 1), window=-1)
