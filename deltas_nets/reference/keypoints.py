"""Key points of the reference network: suppressed in two passes, topped up at random."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from deltas_geom.checks import ShapeError


class DetectedKeypoints(NamedTuple):
    """Key points that come from the detector, and the map they were picked from.

    Attributes:
        nms_kept: ``(H, W)`` uint8, 1 where a score survives suppression.
        detected_xy: ``(M, 2)`` float pixels.
        detected_score: ``(M,)`` probabilities.
    """

    nms_kept: Tensor
    detected_xy: Tensor
    detected_score: Tensor


def pick_keypoints(
    heatmap: Tensor,
    *,
    num_points: int = 512,
    radius: int = 9,
    threshold: float = 0.0005,
    fraction: float = 0.5,
    border: int = 4,
) -> DetectedKeypoints:
    """Detected key points of one image.

    Args:
        heatmap: ``(H, W)`` probability of a key point.
        num_points: key points wanted in all.
        radius: of the suppression, pixels.
        threshold: only scores strictly above it are picked.
        fraction: at most this share of ``num_points`` is detected.
        border: nothing is picked nearer to the image border, pixels.

    Returns:
        In raster order if the budget takes all, else the best in descending order of score.

    Raises:
        ShapeError: the heat map is not ``(H, W)``.
    """
    if heatmap.ndim != 2:
        raise ShapeError(f"heatmap must have shape (H, W), got {tuple(heatmap.shape)}")
    height, width = heatmap.shape
    suppressed = _suppressed(heatmap, radius)
    row, column = torch.where(suppressed > threshold)
    inside = (row >= border) & (row < height - border)
    inside = inside & (column >= border) & (column < width - border)
    row, column = row[inside], column[inside]
    score = suppressed[row, column]
    budget = int(fraction * num_points)
    if len(score) > budget:
        score, best = score.topk(budget)
        row, column = row[best], column[best]
    pixels = torch.stack([column, row], dim=-1).to(heatmap.dtype)
    return DetectedKeypoints((suppressed > 0).to(torch.uint8), pixels, score)


def fill_keypoints(
    detected: DetectedKeypoints, *, num_points: int = 512, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """Key points ``(N, 2)`` and scores ``(N,)``, topped up with random pixels of score 0.

    Random pixels may repeat each other and detected ones, and may lie on the border.

    Args:
        detected: what the detector found, at most ``num_points``.
        num_points: N.
        generator: on the CPU, whatever the device of the points.
    """
    xy, score = detected.detected_xy, detected.detected_score
    height, width = detected.nms_kept.shape
    missing = num_points - len(xy)
    x = torch.randint(width, (missing,), generator=generator)
    y = torch.randint(height, (missing,), generator=generator)
    random = torch.stack([x, y], dim=-1).to(xy)
    return torch.cat([xy, random]), torch.cat([score, score.new_zeros(missing)])


def _suppressed(heatmap: Tensor, radius: int) -> Tensor:
    """Scores of local maxima, and of maxima among what those leave uncovered, else 0."""
    scores = heatmap[None, None]

    def pooled(image: Tensor) -> Tensor:
        return F.max_pool2d(image, 2 * radius + 1, stride=1, padding=radius)

    kept = scores == pooled(scores)
    for _ in range(2):
        covered = pooled(kept.to(scores.dtype)) > 0
        uncovered = torch.where(covered, 0.0, scores)
        kept = kept | ((uncovered == pooled(uncovered)) & ~covered)
    return torch.where(kept, scores, 0.0)[0, 0]
