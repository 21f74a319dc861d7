"""Depth metrics as the original test program computed them; compare with them, not by them.

A negative prediction counts as an inlier, images without true depth lower the means, and batches
count alike whatever their size. `deltas_nets.evaluate.depth_metrics` does none of this.
"""

from collections.abc import Iterable

import torch
from torch import Tensor

from deltas_geom.checks import ShapeError
from deltas_nets.reference.segments import FAR, NEAR


def metric_result(truth: Tensor, prediction: Tensor) -> Tensor:
    """Metrics ``(6,)`` of one batch: abs-rel, abs-diff, sq-rel and three inlier ratios.

    Args:
        truth: ``(B, H, W)`` metres; known within [0.5, 10].
        prediction: ``(B, H, W)`` metres, not clamped.

    Raises:
        ShapeError: the shapes differ or are not ``(B, H, W)``.
    """
    if truth.ndim != 3 or truth.shape != prediction.shape:
        raise ShapeError(
            f"truth and prediction must both have shape (B, H, W), got {tuple(truth.shape)} and "
            f"{tuple(prediction.shape)}"
        )
    total = truth.new_zeros(6)
    for depth, predicted in zip(truth, prediction, strict=True):
        known = (depth >= NEAR) & (depth <= FAR)
        if known.any():
            total = total + _image_metrics(depth[known], predicted[known])
    return total / len(truth)


def mean_result(batches: Iterable[tuple[Tensor, Tensor]]) -> Tensor:
    """Metrics ``(6,)`` of a whole set: the plain mean of its batches' metrics.

    Args:
        batches: (truth, prediction) of each batch; the original had 16 images in all but the
            last.
    """
    return torch.stack([metric_result(*batch) for batch in batches]).mean(dim=0)


def _image_metrics(depth: Tensor, predicted: Tensor) -> Tensor:
    error = depth - predicted
    ratio = torch.maximum(depth / predicted, predicted / depth)
    inliers = [(ratio < 1.25**power).to(depth.dtype).mean() for power in (1, 2, 3)]
    return torch.stack(
        [
            (error.abs() / depth).mean(),
            error.abs().mean(),
            (error.square() / depth).mean(),
            *inliers,
        ]
    )
