"""The loss terms, each visible, and their weighted sum.

The first five are the paper's (section 3.4). 3D points and dense depth are compared relative
to the true depth, so that far walls don't drown near objects.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from kornia.losses import inverse_depth_smoothness_loss
from torch import Tensor

from deltas_geom import Matches, PosedViews, Triangulation
from deltas_nets.config import LossConfig
from deltas_nets.losses.divisors import WHOLE, Counts
from deltas_nets.losses.targets import Targets, detector_labels, keypoint_targets
from deltas_nets.network.deltas import DepthPrediction
from deltas_nets.network.layers import upsample_like
from deltas_nets.network.lite.densifier import DenseDepth
from deltas_nets.network.records import Posterior


class Losses(NamedTuple):
    """Unweighted terms and their weighted sum, scalars."""

    detector: Tensor
    match: Tensor
    point: Tensor
    smoothness: Tensor
    depth: Tensor
    gradient: Tensor
    posterior: Tensor
    confidence: Tensor
    spread: Tensor
    total: Tensor


def training_losses(
    prediction: DepthPrediction,
    images: Tensor,
    views: PosedViews,
    depth: Tensor,
    config: LossConfig,
    *,
    depth_range: tuple[float, float],
    labels: Tensor | None = None,
    counts: Counts = WHOLE,
) -> Losses:
    """All terms for a batch, or for this process's part of one.

    Args:
        prediction: of the network, whose poses may have been noisy.
        images: ``(B, V, 3, H, W)`` as the network saw them.
        views: the true poses.
        depth: ``(B, V, H, W)`` metres, 0 = unknown.
        config: weights of the terms.
        depth_range: as given to the network.
        labels: of the detector, as for :func:`detector_loss`; Shi-Tomasi corners of the anchors
            if not given.
        counts: how the number of places that a term is averaged over becomes that of the batch.
    """
    keypoints = prediction.keypoints
    targets = keypoint_targets(views, depth, keypoints.pixels, depth_range=depth_range)
    dense = prediction.evidence.dense
    truth = depth[:, :1]
    coarse, fine = depth_terms(
        dense, truth, depth_range=depth_range, decay=config.scale_decay, counts=counts
    )
    if labels is None:
        labels = detector_labels(images[:, 0])
    terms = {
        "detector": detector_loss(keypoints.logits, labels),
        "match": match_loss(prediction.matches, targets, counts=counts),
        "point": point_loss(prediction.points, targets, counts=counts),
        "smoothness": smoothness_loss(prediction.depth, images[:, 0]),
        "depth": coarse,
        "gradient": fine,
        "posterior": posterior_loss(prediction.evidence.posterior, targets, counts=counts),
        "confidence": confidence_loss(prediction, targets, counts=counts),
        "spread": spread_loss(dense, truth, depth_range=depth_range, counts=counts),
    }
    total = sum((getattr(config, name) * term for name, term in terms.items()), truth.new_zeros(()))
    return Losses(**terms, total=total)


def masked_mean(values: Tensor, mask: Tensor, counts: Counts = WHOLE) -> Tensor:
    """Mean of the values where the mask holds; 0 where it holds nowhere."""
    return torch.where(mask, values, 0.0).sum() / counts.divisor(mask.sum())


def detector_loss(logits: Tensor, labels: Tensor) -> Tensor:
    """Cross-entropy of which pixel of its cell is an interest point (paper: L_ip).

    Cells are counted from the top left. The paper's heads have none for what the image's height
    and width leave over beyond a multiple of 8; labels of those cells are not used.

    Args:
        logits: ``(B, 65, h, w)``; h is H/8 rounded up or down, w alike.
        labels: ``(B, ceil(H/8), ceil(W/8))`` channels, or ``(B, 65, ceil(H/8), ceil(W/8))``
            distributions over them.
    """
    rows, columns = logits.shape[-2:]
    return F.cross_entropy(logits, labels[..., :rows, :columns])


def match_loss(
    matches: Matches, targets: Targets, *, cap: float = 6.0, counts: Counts = WHOLE
) -> Tensor:
    """Smooth L1 between matched and true pixels of the sources, px (paper: L_2d).

    Beyond ``cap`` px a match is of another place altogether: pulling at it teaches nothing,
    the posterior's cross-entropy does.
    """
    used = targets.visible[:, 1:] & matches.mask[:, 1:]
    error = (matches.pixels[:, 1:] - targets.pixels[:, 1:]).abs().sum(dim=-1)
    near = used & (error.detach() < cap)
    smooth = F.smooth_l1_loss(error, torch.zeros_like(error), reduction="none")
    return masked_mean(smooth, near, counts)


def point_loss(
    points: Triangulation, targets: Targets, *, cap: float = 0.25, counts: Counts = WHOLE
) -> Tensor:
    """Smooth L1 between triangulated and true points, relative to depth (paper: L_3d)."""
    error = (points.points - targets.points).abs().sum(dim=-1)
    relative = error / torch.where(targets.known, targets.depth, 1.0)
    near = targets.known & points.valid & (relative.detach() < cap)
    smooth = F.smooth_l1_loss(relative, torch.zeros_like(relative), reduction="none", beta=0.02)
    return masked_mean(smooth, near, counts)


def smoothness_loss(depth: Tensor, image: Tensor) -> Tensor:
    """Edge-aware smoothness of inverse depth, relative to its mean (paper: L_sm)."""
    inverse = 1 / depth
    relative = inverse / inverse.mean(dim=(-2, -1), keepdim=True).detach()
    loss: Tensor = inverse_depth_smoothness_loss(relative, image.to(relative.dtype))
    return loss


def depth_terms(
    dense: DenseDepth,
    depth: Tensor,
    *,
    depth_range: tuple[float, float],
    decay: float,
    counts: Counts = WHOLE,
) -> tuple[Tensor, Tensor]:
    """Smooth L1 of log depth over four scales (paper: L_d), and L1 of its gradient.

    The first scale has the image's resolution; the others are compared with the mean of the log
    depth in their cells.
    """
    known = _known(depth, depth_range)
    truth = torch.where(known, depth, 1.0).log()
    value, gradient, weight = truth.new_zeros(()), truth.new_zeros(()), 1.0
    for scale, predicted in enumerate(dense.log_depth):
        if scale == 0:
            goal, mask = truth, known
        else:
            size = (predicted.shape[-2], predicted.shape[-1])
            share = F.adaptive_avg_pool2d(known.float(), size)
            total = F.adaptive_avg_pool2d(truth * known, size)
            goal, mask = total / share.clamp_min(1e-6), share > 0.5
        error = F.smooth_l1_loss(predicted, goal, reduction="none", beta=0.02)
        value = value + weight * masked_mean(error, mask, counts)
        if scale < 2:
            gradient = gradient + weight * _gradient_difference(predicted, goal, mask, counts)
        weight *= decay
    return value, gradient


def _gradient_difference(predicted: Tensor, goal: Tensor, mask: Tensor, counts: Counts) -> Tensor:
    across = masked_mean(
        (predicted.diff(dim=-1) - goal.diff(dim=-1)).abs(), mask[..., 1:] & mask[..., :-1], counts
    )
    down = masked_mean(
        (predicted.diff(dim=-2) - goal.diff(dim=-2)).abs(),
        mask[..., 1:, :] & mask[..., :-1, :],
        counts,
    )
    return across + down


def posterior_loss(
    posterior: Posterior, targets: Targets, *, width: float = 0.6, counts: Counts = WHOLE
) -> Tensor:
    """Cross-entropy of every stage's posterior with a bump at the true inverse depth.

    Args:
        posterior: over inverse depth, joint or per view.
        targets: truth.
        width: standard deviation of the bump, in samples.
        counts: as for :func:`training_losses`.
    """
    known = targets.known[:, None]
    true = (1 / torch.where(targets.known, targets.depth, 1.0))[:, None, :, None]
    step = (posterior.inv_depth[..., -1:] - posterior.inv_depth[..., :1]).abs()
    step = (step / (posterior.inv_depth.shape[-1] - 1)).clamp_min(1e-9)
    distance = (posterior.inv_depth - true) / step
    bump = (-distance.square() / (2 * width**2)).softmax(dim=-1)
    # Only where the true depth is among the samples, and one of them can be read.
    inside = (distance.abs().amin(dim=-1) < 1) & posterior.mask.any(dim=-1) & known
    total = true.new_zeros(())
    for number, logits in enumerate(posterior.stages):
        entropy = -(bump * logits.log_softmax(dim=-1)).sum(dim=-1)
        last = number == len(posterior.stages) - 1
        total = total + (1.0 if last or number == 0 else 0.7) * masked_mean(entropy, inside, counts)
    return total


def confidence_loss(
    prediction: DepthPrediction,
    targets: Targets,
    *,
    tolerance: float = 0.05,
    counts: Counts = WHOLE,
) -> Tensor:
    """Cross-entropy of a point's confidence with "its depth is right within 5 %"."""
    depth = prediction.points.depth[:, 0]
    right = ((depth - targets.depth).abs() < tolerance * targets.depth) & prediction.points.valid
    confidence = prediction.evidence.confidence.clamp(1e-4, 1 - 1e-4)
    # Not F.binary_cross_entropy: it raises for NaN, where a bad step is to be skipped.
    entropy = -torch.where(right, confidence, 1 - confidence).log()
    return masked_mean(entropy, targets.known, counts)


def spread_loss(
    dense: DenseDepth, depth: Tensor, *, depth_range: tuple[float, float], counts: Counts = WHOLE
) -> Tensor:
    """Laplace negative log likelihood of the dense map's error under its own spread.

    The error is a constant here: doubt must not become a way to lower the depth loss.
    """
    known = _known(depth, depth_range)
    truth = torch.where(known, depth, 1.0).log()
    error = (dense.log_depth[0] - truth).abs().detach()
    log_spread = upsample_like(dense.log_spread, truth)
    return masked_mean(error * (-log_spread).exp() + log_spread, known, counts)


def _known(depth: Tensor, depth_range: tuple[float, float]) -> Tensor:
    return (depth > 0.8 * depth_range[0]) & (depth < 1.2 * depth_range[1])
