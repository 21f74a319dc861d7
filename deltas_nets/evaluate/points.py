"""Metrics of the triangulated points."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from deltas_nets.evaluate.depth_metrics import DepthMetrics, depth_metrics
from deltas_nets.losses.targets import read_nearest
from deltas_nets.network.prediction import DepthPrediction
from deltas_nets.predict.depth_map import KeypointDepths, keypoint_depths


def score_points(
    prediction: DepthPrediction, truth: NDArray[np.float32], depth_range: tuple[float, float]
) -> DepthMetrics | None:
    """Metrics of all points; those without a valid depth count in coverage.

    Args:
        prediction: of one anchor, without batch dims.
        truth: ``(H, W)`` true depth at any size, metres, 0 = unknown.
        depth_range: (near, far) metres.
    """
    return score_keypoints(keypoint_depths(prediction), truth, depth_range)


def score_keypoints(
    keypoints: KeypointDepths, truth: NDArray[np.float32], depth_range: tuple[float, float]
) -> DepthMetrics | None:
    """Metrics of points of any network; arguments as for :func:`score_points`."""
    predicted, true = _depths(keypoints, truth)
    return depth_metrics(predicted, true, depth_range=depth_range)


def median_point_error(
    prediction: DepthPrediction, truth: NDArray[np.float32], depth_range: tuple[float, float]
) -> float:
    """Median relative depth error of the valid points whose truth is in range; NaN if none."""
    predicted, true = point_depths(prediction, truth)
    used = (true >= depth_range[0]) & (true <= depth_range[1]) & (predicted > 0)
    return float(((predicted - true).abs() / true)[used].median()) if used.any() else float("nan")


def point_depths(prediction: DepthPrediction, truth: NDArray[np.float32]) -> tuple[Tensor, Tensor]:
    """Predicted (0 where not valid) and true depth of the N keypoints, metres."""
    return _depths(keypoint_depths(prediction), truth)


def _depths(keypoints: KeypointDepths, truth: NDArray[np.float32]) -> tuple[Tensor, Tensor]:
    height, width = keypoints.image_size
    scale = torch.tensor([truth.shape[1] / width, truth.shape[0] / height])
    places = (keypoints.pixels.cpu() + 0.5) * scale - 0.5
    return keypoints.depth.cpu(), read_nearest(torch.from_numpy(truth), places)
