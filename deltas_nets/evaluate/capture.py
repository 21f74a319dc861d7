"""A capture's depth maps against its sensor depth."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from deltas_nets.data.capture import Capture
from deltas_nets.data.sample import depth_at_image
from deltas_nets.data.view_sets import ViewSet
from deltas_nets.errors import UserError
from deltas_nets.evaluate.depth_metrics import DepthMetrics, depth_metrics, mean_metrics
from deltas_nets.evaluate.points import score_points
from deltas_nets.network.deltas import Deltas
from deltas_nets.outputs import read_depth_png
from deltas_nets.predict import PredictConfig, predict_frame


class CaptureScores(NamedTuple):
    """Means over the view sets of a capture.

    Attributes:
        dense: of the depth maps.
        median_scaled: the same after each map is scaled to the true median: what remains is
            not the poses' scale.
        sparse: of the triangulated points; None when maps from files are scored.
        frames: Abs Rel of each anchor.
    """

    dense: DepthMetrics
    median_scaled: DepthMetrics
    sparse: DepthMetrics | None
    frames: dict[str, float]


class _FrameScores(NamedTuple):
    dense: DepthMetrics
    scaled: DepthMetrics
    sparse: DepthMetrics | None


def evaluate_network(
    model: Deltas,
    capture: Capture,
    view_sets: Sequence[ViewSet],
    config: PredictConfig,
    *,
    report: Callable[[str], None] = lambda _: None,
) -> CaptureScores:
    """Predict every view set and score it.

    Args:
        model: a trained network.
        capture: frames with sensor depth.
        view_sets: anchors and sources.
        config: as for prediction.
        report: called with the id of every finished frame.

    Raises:
        UserError: an anchor has no sensor depth, or none of it is in range.
    """
    scores = {}
    for views in view_sets:
        anchor = capture.frame(views.anchor)
        truth = depth_at_image(anchor)
        frames = [anchor, *(capture.frame(id) for id in views.sources)]
        result = predict_frame(model, frames, config)
        sparse = score_points(result.prediction, truth, config.depth_range)
        scores[str(views.anchor)] = _score(result.depth, truth, config.depth_range, sparse)
        report(str(views.anchor))
    return _mean(scores, capture.path)


def evaluate_files(
    predictions: Path,
    capture: Capture,
    view_sets: Sequence[ViewSet],
    *,
    depth_range: tuple[float, float],
) -> CaptureScores:
    """Score the maps that `deltas depth` wrote.

    Args:
        predictions: its output folder.
        capture: frames with sensor depth.
        view_sets: whose anchors are scored.
        depth_range: (near, far) of the true depth that counts, metres.

    Raises:
        UserError: a map is missing or cannot be read.
    """
    scores = {}
    for views in view_sets:
        file = predictions / "depth" / f"{views.anchor}.png"
        try:
            predicted = read_depth_png(file)
        except OSError as error:
            raise UserError(
                f"no depth map ({error.strerror or error})", file, "run deltas depth first"
            ) from error
        truth = depth_at_image(capture.frame(views.anchor))
        scores[str(views.anchor)] = _score(predicted, truth, depth_range, None)
    return _mean(scores, capture.path)


def _score(
    predicted: NDArray[np.float32],
    truth: NDArray[np.float32],
    depth_range: tuple[float, float],
    sparse: DepthMetrics | None,
) -> _FrameScores | None:
    truth = resize_nearest(truth, (predicted.shape[0], predicted.shape[1]))
    dense = depth_metrics(predicted, truth, depth_range=depth_range)
    if dense is None:
        return None
    near, far = depth_range
    both = (truth >= near) & (truth <= far) & (predicted > 0)
    scale = float(np.median(truth[both] / predicted[both])) if both.any() else 1.0
    scaled = depth_metrics(predicted * scale, truth, depth_range=depth_range)
    assert scaled is not None
    return _FrameScores(dense, scaled, sparse)


def resize_nearest(image: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    """Depth ``(H, W)`` at another size: the value of the pixel that holds each new centre."""
    if image.shape == size:
        return image
    resized = F.interpolate(torch.from_numpy(image)[None, None], size=size, mode="nearest-exact")
    array: NDArray[np.float32] = resized[0, 0].numpy()
    return array


def _mean(scores: dict[str, _FrameScores | None], path: Path) -> CaptureScores:
    found = {id: score for id, score in scores.items() if score is not None}
    if not found:
        raise UserError(
            "no anchor has true depth in range", path, "name a capture with sensor depth"
        )
    sparse = [score.sparse for score in found.values() if score.sparse is not None]
    return CaptureScores(
        dense=mean_metrics([score.dense for score in found.values()]),
        median_scaled=mean_metrics([score.scaled for score in found.values()]),
        sparse=mean_metrics(sparse) if sparse else None,
        frames={id: score.dense.abs_rel for id, score in found.items()},
    )
