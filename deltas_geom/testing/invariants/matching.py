"""Invariants of soft-argmax: of places anywhere, and of the pixels of a heatmap."""

import math

import torch
from torch import Tensor

from deltas_geom.cameras.pixels import pixel_grid
from deltas_geom.testing.agreement import (
    VALUE_TOLERANCE,
    assert_finite,
    assert_gradients,
    assert_near,
    gradients,
    slack,
)
from deltas_geom.testing.planar import ScoreScene
from deltas_geom.testing.registry import invariant
from deltas_geom.testing.target import Target

CERTAIN = 1000.0
"""A logit beside which one of 0 has no probability, in any precision."""


@invariant("soft_argmax", scenes="scores")
def the_soft_argmax_is_the_mean_under_the_softmax(target: Target, scene: ScoreScene) -> None:
    """The position is the sum of positions times exp(logit), over the sum of exp(logit)."""
    weights = torch.where(scene.mask, scene.logits, -torch.inf).flatten()
    weights = (weights - weights.max()).exp()
    wanted = (weights @ torch.where(weights[:, None] > 0, scene.positions, 0.0)) / weights.sum()
    assert_near(_position(target, scene), wanted, VALUE_TOLERANCE * 100, "(position)")


@invariant("soft_argmax", scenes="scores")
def the_soft_argmax_of_a_delta_is_the_delta(
    target: Target, scene: ScoreScene, *, place: int = 1
) -> None:
    """All probability in one place gives its position."""
    certain = _certain(scene, place)
    wanted = scene.positions[place]
    assert_near(_position(target, certain), wanted, VALUE_TOLERANCE, "(position)")


@invariant("soft_argmax", scenes="scores")
def the_soft_argmax_moves_with_the_positions(
    target: Target, scene: ScoreScene, *, shift: float = 7.0, constant: float = -50.0
) -> None:
    """Moved positions move the mean, and a constant on all logits does not."""
    moved = scene._replace(logits=scene.logits + constant, positions=scene.positions + shift)
    wanted = _position(target, scene) + shift
    assert_near(_position(target, moved), wanted, VALUE_TOLERANCE * 100, "(position)")


@invariant("soft_argmax", scenes="scores")
def what_is_masked_does_not_count(target: Target, scene: ScoreScene) -> None:
    """Masked places may have any logit and position, also NaN."""
    mask = scene.mask.clone()
    mask[0, 0] = mask[-1, -1] = False
    mask[-1, 0] = True
    masked = scene._replace(mask=mask)
    wanted = _position(target, masked)
    for junk in (1e9, torch.nan):
        spoiled = masked._replace(
            logits=torch.where(mask, scene.logits, junk),
            positions=torch.where(mask.flatten()[:, None], scene.positions, junk),
        )
        assert_near(_position(target, spoiled), wanted, VALUE_TOLERANCE * 100, "(position)")


@invariant("soft_argmax", scenes="scores")
def the_soft_argmax_is_finite(target: Target, scene: ScoreScene) -> None:
    """The position is finite for logits of any finite size, and where all is masked."""
    for factor in (1e30, -1e30, 1e-30):
        assert_finite(_position(target, scene._replace(logits=factor * scene.logits)), "position")
    nothing = scene._replace(mask=torch.zeros_like(scene.mask))
    assert_finite(_position(target, nothing), "position where all is masked,")


@invariant("soft_argmax", "autograd", scenes="scores")
def gradients_of_the_soft_argmax_are_finite_differences(target: Target, scene: ScoreScene) -> None:
    """The gradient is that of finite differences, and finite where all is masked."""

    def mean(logits: Tensor, positions: Tensor) -> Tensor:
        return _position(target, scene._replace(logits=logits, positions=positions))

    inputs = [scene.logits, scene.positions]
    assert_gradients(mean, inputs, ("logits", "positions"), "(position)")

    def masked(logits: Tensor, positions: Tensor) -> Tensor:
        none = ScoreScene(logits, positions, torch.zeros_like(scene.mask))
        found = _position(target, none)
        return found[found.isfinite()].sum()

    for gradient in gradients(masked, inputs):
        assert_finite(gradient, "where all is masked the gradient")


@invariant("soft_covariance", scenes="scores")
def the_covariance_of_a_delta_is_0(target: Target, scene: ScoreScene, *, place: int = 1) -> None:
    """All probability in one place leaves no spread."""
    found = _covariance(target, _certain(scene, place))
    assert_near(found, torch.zeros_like(found), VALUE_TOLERANCE, "(position squared)")


@invariant("soft_covariance", scenes="scores")
def the_covariance_of_two_places_is_their_distance(target: Target, scene: ScoreScene) -> None:
    """Three quarters and one of the probability in two places: 3/16 d d^T, d the way between."""
    pair = _certain(scene, 0)
    pair.logits.sub_(CERTAIN)
    pair.logits[-1, -1] = -math.log(3)
    way = scene.positions[-1] - scene.positions[0]
    wanted = 3 / 16 * way[:, None] * way
    assert_near(_covariance(target, pair), wanted, VALUE_TOLERANCE * 100, "(position squared)")


@invariant("soft_covariance", scenes="scores")
def the_covariance_does_not_know_where_it_is(
    target: Target, scene: ScoreScene, *, shift: float = 7.0
) -> None:
    """Moving all positions changes no covariance; doubling them makes it four times as large."""
    wanted = _covariance(target, scene)
    moved = scene._replace(positions=2 * scene.positions + shift)
    found = _covariance(target, moved) / 4
    assert_near(found, wanted, VALUE_TOLERANCE * 1000, "(position squared)")
    # Of pixels in float32, differences of squares are roundings.
    far = ScoreScene(scene.logits.float(), (scene.positions + 1024).float(), scene.mask)
    found = _covariance(target, far).to(wanted)
    assert_near(found, wanted, max(2e-3 / slack(), VALUE_TOLERANCE * 1000), "(position squared)")


@invariant("soft_covariance", scenes="scores")
def what_is_masked_has_no_spread(target: Target, scene: ScoreScene) -> None:
    """A masked place counts as one that is not there, whatever its logit and position, also NaN."""
    mask = scene.mask.flatten().clone()
    mask[0], mask[-1] = False, True
    logits, positions = scene.logits.flatten(), scene.positions
    assert target.soft_covariance is not None
    wanted = target.soft_covariance(logits[mask], positions[mask], mask[mask])
    for junk in (1e9, torch.nan):
        found = target.soft_covariance(
            torch.where(mask, logits, junk), torch.where(mask[:, None], positions, junk), mask
        )
        assert_near(found, wanted, VALUE_TOLERANCE * 1000, "(position squared)")


@invariant("heatmap_argmax", scenes="scores")
def the_soft_argmax_of_a_heatmap_peak_is_its_pixel(target: Target, scene: ScoreScene) -> None:
    """All probability in one pixel gives its (x, y), the top-left one being (0, 0)."""
    height, width = scene.logits.shape
    for row, column in ((0, 0), (0, width - 1), (height - 1, 0)):
        logits = torch.zeros_like(scene.logits)
        logits[row, column] = CERTAIN
        wanted = logits.new_tensor([column, row])
        assert_near(_pixel(target, logits), wanted, VALUE_TOLERANCE, "px")


@invariant("heatmap_argmax", scenes="scores")
def the_soft_argmax_of_a_heatmap_is_its_mean_pixel(target: Target, scene: ScoreScene) -> None:
    """The pixel is the mean of pixels weighted by exp(logit)."""
    height, width = scene.logits.shape
    share = (scene.logits - scene.logits.max()).exp().flatten()
    wanted = share @ pixel_grid((height, width), dtype=share.dtype) / share.sum()
    assert_near(_pixel(target, scene.logits), wanted, VALUE_TOLERANCE, "px")


@invariant("heatmap_argmax", scenes="scores")
def the_soft_argmax_of_a_heatmap_moves_with_it(
    target: Target, scene: ScoreScene, *, right: int = 2, down: int = 1
) -> None:
    """A heatmap that is moved by whole pixels moves its soft-argmax by as much."""
    # A border without probability, in which there is place to move.
    still = torch.nn.functional.pad(scene.logits, (0, right, 0, down), value=-CERTAIN)
    moved = torch.nn.functional.pad(scene.logits, (right, 0, down, 0), value=-CERTAIN)
    shift = scene.logits.new_tensor([right, down])
    assert_near(_pixel(target, moved), _pixel(target, still) + shift, VALUE_TOLERANCE, "px")


@invariant("heatmap_argmax", scenes="scores")
def the_soft_argmax_of_a_heatmap_is_finite(target: Target, scene: ScoreScene) -> None:
    """The pixel is finite for logits of any finite size."""
    for factor in (1e30, -1e30, 1e-30):
        assert_finite(_pixel(target, factor * scene.logits), "pixel")


def _certain(scene: ScoreScene, place: int) -> ScoreScene:
    logits = torch.zeros_like(scene.logits)
    logits.view(-1)[place] = CERTAIN
    return scene._replace(logits=logits, mask=torch.ones_like(scene.mask))


def _position(target: Target, scene: ScoreScene) -> Tensor:
    assert target.soft_argmax is not None
    return target.soft_argmax(scene.logits.flatten(), scene.positions, scene.mask.flatten())


def _covariance(target: Target, scene: ScoreScene) -> Tensor:
    assert target.soft_covariance is not None
    return target.soft_covariance(scene.logits.flatten(), scene.positions, scene.mask.flatten())


def _pixel(target: Target, logits: Tensor) -> Tensor:
    assert target.heatmap_argmax is not None
    return target.heatmap_argmax(logits)
