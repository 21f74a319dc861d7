"""What is said of a depth map, and of many."""

from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from deltas_nets.evaluate.calibration import Calibration
from deltas_nets.evaluate.depth_metrics import DepthMetrics, depth_metrics, mean_metrics


class CaptureScores(NamedTuple):
    """Means over the view sets of a capture, or over rooms.

    Attributes:
        dense: of the depth maps.
        median_scaled: the same after each map is scaled to the true median: what remains is
            not the poses' scale.
        sparse: of the triangulated points; None when maps from files are scored.
        frames: Abs Rel of each anchor, or of each room by its number.
        calibration: of the predicted standard deviation; None where there is none.
    """

    dense: DepthMetrics
    median_scaled: DepthMetrics
    sparse: DepthMetrics | None
    frames: dict[str, float]
    calibration: Calibration | None = None


class MapScores(NamedTuple):
    """Metrics of one map, as in :class:`CaptureScores`."""

    dense: DepthMetrics
    scaled: DepthMetrics
    sparse: DepthMetrics | None


def score_map(
    predicted: NDArray[np.float32],
    truth: NDArray[np.float32],
    depth_range: tuple[float, float],
    sparse: DepthMetrics | None,
) -> MapScores | None:
    """Metrics of one map at its own size; None if no true depth is in range.

    Args:
        predicted: ``(H, W)`` metres, 0 = none.
        truth: ``(h, w)`` metres, 0 = unknown.
        depth_range: (near, far) of the true depth that counts, metres.
        sparse: of the points it rests on.
    """
    truth = resize_nearest(truth, (predicted.shape[0], predicted.shape[1]))
    dense = depth_metrics(predicted, truth, depth_range=depth_range)
    if dense is None:
        return None
    near, far = depth_range
    both = (truth >= near) & (truth <= far) & (predicted > 0)
    scale = float(np.median(truth[both] / predicted[both])) if both.any() else 1.0
    scaled = depth_metrics(predicted * scale, truth, depth_range=depth_range)
    assert scaled is not None
    return MapScores(dense, scaled, sparse)


def mean_scores(
    scores: dict[str, MapScores | None], calibration: Calibration | None = None
) -> CaptureScores:
    """Means over the maps that have true depth in range.

    Raises:
        ValueError: none has.
    """
    found = {id: score for id, score in scores.items() if score is not None}
    sparse = [score.sparse for score in found.values() if score.sparse is not None]
    return CaptureScores(
        dense=mean_metrics([score.dense for score in found.values()]),
        median_scaled=mean_metrics([score.scaled for score in found.values()]),
        sparse=mean_metrics(sparse) if sparse else None,
        frames={id: score.dense.abs_rel for id, score in found.items()},
        calibration=calibration,
    )


def resize_nearest(image: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    """Depth ``(H, W)`` at another size: the value of the pixel that holds each new centre."""
    if image.shape == size:
        return image
    resized = F.interpolate(torch.from_numpy(image)[None, None], size=size, mode="nearest-exact")
    array: NDArray[np.float32] = resized[0, 0].numpy()
    return array
