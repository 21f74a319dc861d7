"""What is said of a depth map, and of many."""

from collections.abc import Mapping
from functools import reduce
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from deltas_nets.evaluate.alignment import align
from deltas_nets.evaluate.calibration import Calibration
from deltas_nets.evaluate.consistency import Consistency
from deltas_nets.evaluate.depth_metrics import DepthMetrics, DepthSums, depth_sums, mean_metrics
from deltas_nets.evaluate.sparsification import ause

__all__ = ["CaptureScores", "MapScores", "mean_scores", "resize_nearest", "score_map"]

Map = NDArray[np.float32]


class MapScores(NamedTuple):
    """Metrics of one map, as in :class:`CaptureScores`."""

    dense: DepthMetrics
    scaled: DepthMetrics
    sparse: DepthMetrics | None
    fitted: DepthMetrics
    sums: DepthSums
    ause: float | None


class CaptureScores(NamedTuple):
    """Means over the view sets of a capture, over rooms, or over the maps of several scenes.

    Attributes:
        dense: of the depth maps.
        median_scaled: the same after each map is scaled to the true median: what remains is
            not the poses' scale.
        sparse: of the triangulated points; None when maps from files are scored.
        frames: Abs Rel of each anchor, or of each room by its number.
        calibration: of the predicted standard deviation; None where there is none.
        fitted: the same as ``dense`` after scale and shift of each map are fitted.
        pooled: of the pixels of all maps together.
        ause: mean area under the sparsification error; None where no deviation is stated.
        maps: all of each map that has true depth in range, by the id of its frame.
        without_truth: ids of frames without true depth in range.
        failed: why there is no map, by the ids of the frames that failed.
        consistency: of the maps with each other, if it was asked for.
        metric: whether lengths are in metres; if not, in the unit of their capture.
    """

    dense: DepthMetrics
    median_scaled: DepthMetrics
    sparse: DepthMetrics | None
    frames: dict[str, float]
    calibration: Calibration | None
    fitted: DepthMetrics
    pooled: DepthMetrics
    ause: float | None
    maps: dict[str, MapScores]
    without_truth: tuple[str, ...]
    failed: dict[str, str]
    consistency: Consistency | None
    metric: bool


def score_map(
    predicted: Map,
    truth: Map,
    depth_range: tuple[float, float],
    sparse: DepthMetrics | None,
    relative_std: Map | None = None,
) -> MapScores | None:
    """Metrics of one map at its own size; None if no true depth is in range.

    Args:
        predicted: ``(H, W)`` metres, 0 = none.
        truth: ``(h, w)`` metres, 0 = unknown.
        depth_range: (near, far) of the true depth that counts, metres.
        sparse: of the points it rests on.
        relative_std: ``(H, W)`` its stated deviation, a share of the depth, if any.
    """
    truth = resize_nearest(truth, (predicted.shape[0], predicted.shape[1]))
    sums = depth_sums(predicted, truth, depth_range=depth_range)
    if sums is None:
        return None
    moved = [
        depth_sums(
            align(predicted, truth, kind, depth_range=depth_range).depth,
            truth,
            depth_range=depth_range,
        )
        for kind in ("median", "scale-and-shift")
    ]
    scaled, fitted = (each.metrics() for each in moved if each is not None)
    area = None
    if relative_std is not None:
        area = ause(predicted, relative_std, truth, depth_range=depth_range)
    return MapScores(sums.metrics(), scaled, sparse, fitted, sums, area)


def mean_scores(
    scores: Mapping[str, MapScores | None],
    calibration: Calibration | None = None,
    *,
    failed: Mapping[str, str] | None = None,
    consistency: Consistency | None = None,
    metric: bool = True,
) -> CaptureScores:
    """Means over the maps that have true depth in range.

    Args:
        scores: of each map; None where no true depth is in range.
        calibration: of all maps.
        failed: why there is no map of other frames.
        consistency: of all maps.
        metric: whether all of them are in metres.

    Raises:
        ValueError: none has.
    """
    found = {id: score for id, score in scores.items() if score is not None}
    sparse = [score.sparse for score in found.values() if score.sparse is not None]
    areas = [score.ause for score in found.values() if score.ause is not None]
    dense = mean_metrics([score.dense for score in found.values()])
    return CaptureScores(
        dense=dense,
        median_scaled=mean_metrics([score.scaled for score in found.values()]),
        sparse=mean_metrics(sparse) if sparse else None,
        frames={id: score.dense.abs_rel for id, score in found.items()},
        calibration=calibration,
        fitted=mean_metrics([score.fitted for score in found.values()]),
        pooled=reduce(DepthSums.plus, (score.sums for score in found.values())).metrics(),
        ause=float(np.nanmean(areas)) if np.isfinite(areas).any() else None,
        maps=found,
        without_truth=tuple(id for id, score in scores.items() if score is None),
        failed=dict(failed or {}),
        consistency=consistency,
        metric=metric,
    )


def resize_nearest(image: Map, size: tuple[int, int]) -> Map:
    """Depth ``(H, W)`` at another size: the value of the pixel that holds each new centre."""
    if image.shape == size:
        return image
    resized = F.interpolate(torch.from_numpy(image)[None, None], size=size, mode="nearest-exact")
    array: Map = resized[0, 0].numpy()
    return array
