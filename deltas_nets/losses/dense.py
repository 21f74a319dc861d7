"""Losses of the dense map: its depth at all scales, its edges, its own uncertainty.

Those of the paper are in its section 3.4. Depth is compared by its log, so that far walls don't
drown near objects.
"""

import torch
import torch.nn.functional as F
from kornia.losses import inverse_depth_smoothness_loss
from torch import Tensor

from deltas_nets.losses.divisors import Divisors
from deltas_nets.losses.seen import SeenMap, masked_mean
from deltas_nets.network.layers import upsample_like


def smoothness_loss(seen: SeenMap) -> Tensor:
    """Edge-aware smoothness of inverse depth, relative to its mean (paper: L_sm)."""
    inverse = (-seen.dense.log_depth[0]).exp()
    relative = inverse / inverse.mean(dim=(-2, -1), keepdim=True).detach()
    loss: Tensor = inverse_depth_smoothness_loss(relative, seen.image.to(relative.dtype))
    return loss


def depth_loss(seen: SeenMap) -> Tensor:
    """Smooth L1 of log depth over four scales (paper: L_d).

    The first scale has the image's resolution; the others are compared with the mean of the log
    depth in their cells.
    """
    loss = seen.depth.new_zeros(())
    for scale, predicted in enumerate(seen.dense.log_depth):
        goal, mask = _log_depth_like(predicted, seen)
        error = F.smooth_l1_loss(predicted, goal, reduction="none", beta=0.02)
        loss = loss + seen.decay**scale * masked_mean(error, mask, seen.divisors)
    return loss


def gradient_loss(seen: SeenMap) -> Tensor:
    """L1 of the gradient of log depth at the two finest scales."""
    loss = seen.depth.new_zeros(())
    for scale, predicted in enumerate(seen.dense.log_depth[:2]):
        goal, mask = _log_depth_like(predicted, seen)
        difference = _gradient_difference(predicted, goal, mask, seen.divisors)
        loss = loss + seen.decay**scale * difference
    return loss


def spread_loss(seen: SeenMap) -> Tensor:
    """Laplace negative log likelihood of the dense map's error under its own spread.

    The error is a constant here: doubt must not become a way to lower the depth loss.
    """
    known = _known(seen)
    truth = torch.where(known, seen.depth, 1.0).log()
    error = (seen.dense.log_depth[0] - truth).abs().detach()
    log_spread = upsample_like(seen.dense.log_spread, truth)
    return masked_mean(error * (-log_spread).exp() + log_spread, known, seen.divisors)


def _log_depth_like(predicted: Tensor, seen: SeenMap) -> tuple[Tensor, Tensor]:
    """The true log depth at a scale of the dense map, and where it is known."""
    known = _known(seen)
    truth = torch.where(known, seen.depth, 1.0).log()
    size = (predicted.shape[-2], predicted.shape[-1])
    if size == truth.shape[-2:]:
        return truth, known
    share = F.adaptive_avg_pool2d(known.float(), size)
    return F.adaptive_avg_pool2d(truth * known, size) / share.clamp_min(1e-6), share > 0.5


def _gradient_difference(
    predicted: Tensor, goal: Tensor, mask: Tensor, divisors: Divisors
) -> Tensor:
    across = masked_mean(
        (predicted.diff(dim=-1) - goal.diff(dim=-1)).abs(), mask[..., 1:] & mask[..., :-1], divisors
    )
    down = masked_mean(
        (predicted.diff(dim=-2) - goal.diff(dim=-2)).abs(),
        mask[..., 1:, :] & mask[..., :-1, :],
        divisors,
    )
    return across + down


def _known(seen: SeenMap) -> Tensor:
    near, far = seen.depth_range
    return (seen.depth > 0.8 * near) & (seen.depth < 1.2 * far)
