"""Losses of interest points: where they are, are seen, and how far away.

Those of the paper are in its section 3.4. 3D points are compared relative to the true depth, so
that far walls don't drown near objects.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from deltas_nets.losses.seen import Seen, masked_mean

MATCH_CAP = 6.0
"""Beyond so many pixels a match is of another place altogether."""
POINT_CAP = 0.25
"""Likewise of points, a share of their depth."""
BUMP = 0.6
"""Standard deviation of the bump at the true inverse depth, in samples."""
RIGHT = 0.05
"""A depth is right within this share of it."""


def detector_loss(seen: Seen) -> Tensor:
    """Cross-entropy of which pixel of its cell is an interest point (paper: L_ip)."""
    return cell_entropy(seen.prediction.keypoints.logits, seen.labels)


def cell_entropy(logits: Tensor, labels: Tensor) -> Tensor:
    """Cross-entropy of the channels of 8 x 8 cells, counted from the top left.

    The paper's heads have no cells for what the image's height and width leave over beyond a
    multiple of 8; labels of those cells are not used.

    Args:
        logits: ``(B, 65, h, w)``; h is H/8 rounded up or down, w alike.
        labels: as in :class:`Seen`.
    """
    rows, columns = logits.shape[-2:]
    return F.cross_entropy(logits, labels[..., :rows, :columns])


def match_loss(seen: Seen) -> Tensor:
    """Smooth L1 between matched and true pixels of the sources, px (paper: L_2d).

    A match of another place altogether is not pulled at: that teaches nothing, the posterior's
    cross-entropy does.
    """
    matches, targets = seen.prediction.matches, seen.targets
    used = targets.visible[:, 1:] & matches.mask[:, 1:]
    error = (matches.pixels[:, 1:] - targets.pixels[:, 1:]).abs().sum(dim=-1)
    near = used & (error.detach() < MATCH_CAP)
    smooth = F.smooth_l1_loss(error, torch.zeros_like(error), reduction="none")
    return masked_mean(smooth, near, seen.divisors)


def point_loss(seen: Seen) -> Tensor:
    """Smooth L1 between triangulated and true points, relative to depth (paper: L_3d)."""
    points, targets = seen.prediction.points, seen.targets
    error = (points.points - targets.points).abs().sum(dim=-1)
    relative = error / torch.where(targets.known, targets.depth, 1.0)
    near = targets.known & points.valid & (relative.detach() < POINT_CAP)
    smooth = F.smooth_l1_loss(relative, torch.zeros_like(relative), reduction="none", beta=0.02)
    return masked_mean(smooth, near, seen.divisors)


def posterior_loss(seen: Seen) -> Tensor:
    """Cross-entropy of every stage's posterior with a bump at the true inverse depth.

    The posterior may be joint or per view.
    """
    posterior, targets = seen.prediction.evidence.posterior, seen.targets
    known = targets.known[:, None]
    true = (1 / torch.where(targets.known, targets.depth, 1.0))[:, None, :, None]
    step = (posterior.inv_depth[..., -1:] - posterior.inv_depth[..., :1]).abs()
    step = (step / (posterior.inv_depth.shape[-1] - 1)).clamp_min(1e-9)
    distance = (posterior.inv_depth - true) / step
    bump = (-distance.square() / (2 * BUMP**2)).softmax(dim=-1)
    # Only where the true depth is among the samples, and one of them can be read.
    inside = (distance.abs().amin(dim=-1) < 1) & posterior.mask.any(dim=-1) & known
    total = true.new_zeros(())
    for number, logits in enumerate(posterior.stages):
        entropy = -(bump * logits.log_softmax(dim=-1)).sum(dim=-1)
        last = number == len(posterior.stages) - 1
        total = total + (1.0 if last or number == 0 else 0.7) * masked_mean(
            entropy, inside, seen.divisors
        )
    return total


def confidence_loss(seen: Seen) -> Tensor:
    """Cross-entropy of a point's confidence with "its depth is right within 5 %"."""
    prediction, targets = seen.prediction, seen.targets
    depth = prediction.points.depth[:, 0]
    right = ((depth - targets.depth).abs() < RIGHT * targets.depth) & prediction.points.valid
    confidence = prediction.evidence.confidence.clamp(1e-4, 1 - 1e-4)
    # Not F.binary_cross_entropy: it raises for NaN, where a bad step is to be skipped.
    entropy = -torch.where(right, confidence, 1 - confidence).log()
    return masked_mean(entropy, targets.known, seen.divisors)
