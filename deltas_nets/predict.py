"""From posed frames to depth maps: one frame, or a whole capture into a folder."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from deltas_geom import PosedViews, unproject
from deltas_nets.data.capture import Capture, Frame
from deltas_nets.data.sample import fit_work_size, load_views, resize_image
from deltas_nets.data.view_sets import ViewSet
from deltas_nets.network.deltas import Deltas, DepthPrediction
from deltas_nets.outputs import OutputFolder

WORK_PIXELS = 120_000
"""Pixels of the image that the network sees, unless a size is given; see decision 5."""


@dataclass(frozen=True)
class PredictConfig:
    """What a depth map depends on besides its frames and the weights."""

    depth_range: tuple[float, float] = (0.5, 10.0)
    """Nearest and farthest depth searched, metres."""
    work_size: tuple[int, int] | None = None
    """(height, width) that the network sees; chosen to suit it if not given."""
    size: tuple[int, int] | None = None
    """(height, width) of the maps; the colour image's own if not given."""
    min_confidence: float = 0.0
    """Pixels of less confidence (0 to 1) are left out; 0 keeps every pixel."""

    def __post_init__(self) -> None:
        near, far = self.depth_range
        if not 0 < near < far:
            raise ValueError(
                f"--depth-range must be NEAR FAR with 0 < NEAR < FAR, got {near} {far}"
            )
        for name, size in (("--work-size", self.work_size), ("--size", self.size)):
            if size is not None and min(size) < 32:
                raise ValueError(f"{name} must be HEIGHT WIDTH of 32 or more, got {size}")
        if not 0 <= self.min_confidence <= 1:
            raise ValueError(f"--min-confidence must be within 0 to 1, got {self.min_confidence}")


SECONDS_BETWEEN_SUMMARIES = 5.0


class Counts(NamedTuple):
    """What became of the view sets: maps written, kept from before, and written blindly."""

    written: int
    kept: int
    blind: int


class FrameDepth(NamedTuple):
    """Depth of one frame.

    Attributes:
        depth: ``(H, W)`` float32 metres; 0 where ``min_confidence`` removed it.
        confidence: ``(H, W)`` float32, probability that the relative error is below 5 %.
        points: ``(N, 3)`` in the capture's world, metres.
        colors: ``(N, 3)`` uint8.
        prediction: what the network gave, at the size it works at.
        images: ``(V, 3, h, w)`` the frames as the network saw them.
        views: the cameras, relative to the anchor, at the network's size.
    """

    depth: NDArray[np.float32]
    confidence: NDArray[np.float32]
    points: NDArray[np.float32]
    colors: NDArray[np.uint8]
    prediction: DepthPrediction
    images: torch.Tensor
    views: PosedViews


@torch.inference_mode()
def predict_frame(model: Deltas, frames: Sequence[Frame], config: PredictConfig) -> FrameDepth:
    """Depth of the first frame from all of them.

    Args:
        model: a trained network, on any device.
        frames: the anchor and its sources.
        config: sizes, range, confidence.

    Raises:
        UserError: an image cannot be read.
    """
    device = next(model.parameters()).device
    anchor = frames[0]
    work_size = config.work_size or fit_work_size(anchor.image_size, max_pixels=WORK_PIXELS)
    images, views = load_views(frames, work_size=work_size)
    prediction = model(images.to(device), views.to(device), config.depth_range)
    size = config.size or anchor.image_size
    depth = _resized(prediction.depth, size)
    confidence = _resized(prediction.confidence(), size)
    kept = confidence >= config.min_confidence
    points, colors = _point_cloud(anchor, depth * kept, size, work_size)
    return FrameDepth(
        np.where(kept, depth, 0), confidence, points, colors, prediction, images, views
    )


def _resized(image: torch.Tensor, size: tuple[int, int]) -> NDArray[np.float32]:
    resized = F.interpolate(image[None], size=size, mode="bilinear", align_corners=False)
    array: NDArray[np.float32] = resized[0, 0].float().cpu().numpy()
    return array


def _point_cloud(
    anchor: Frame, depth: NDArray[np.float32], size: tuple[int, int], work_size: tuple[int, int]
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """World points of the map, about as many as the network has pixels, with their colours."""
    step = max(1, round(size[0] / work_size[0]))
    rows, columns = np.mgrid[step // 2 : size[0] : step, step // 2 : size[1] : step].reshape(2, -1)
    z = torch.from_numpy(depth[rows, columns]).double()
    view = PosedViews(
        torch.tensor(anchor.K)[None], torch.tensor(anchor.cam_from_world)[None]
    ).resize(old_size=anchor.image_size, new_size=size)
    pixels = torch.from_numpy(np.stack([columns, rows], axis=-1)).double()
    points = unproject(view, pixels[None], z[None])[0]
    colors = resize_image(anchor.read_image(), size)[rows, columns]
    known = z.numpy() > 0
    return points.numpy()[known].astype(np.float32), colors[known]


def predict_capture(
    model: Deltas,
    capture: Capture,
    view_sets: Sequence[ViewSet],
    folder: OutputFolder,
    config: PredictConfig,
    *,
    report: Callable[[str], None] = lambda _: None,
) -> Counts:
    """Write depth, confidence and points of every view set that is not finished yet.

    Args:
        model: a trained network.
        capture: the frames.
        view_sets: anchors and sources.
        folder: from :func:`deltas_nets.outputs.prepare_output`.
        config: sizes, range, confidence.
        report: called with the id of every finished frame.

    Returns:
        How many maps were written, kept, and written without a single triangulated point.

    Raises:
        UserError: a file cannot be read or written. What is finished by then stays, and is
            kept when the same is asked for again.
    """
    counts = Counts(0, 0, 0)
    began = recorded = time.perf_counter()
    status = "stopped"
    try:
        for views in view_sets:
            if folder.is_finished(views.anchor):
                folder.keep_frame(views.anchor)
                counts = counts._replace(kept=counts.kept + 1)
            else:
                blind = _predict_into(model, capture, views, folder, config)
                counts = Counts(counts.written + 1, counts.kept, counts.blind + blind)
            if time.perf_counter() - recorded > SECONDS_BETWEEN_SUMMARIES:
                folder.write_summary("running")
                recorded = time.perf_counter()
            report(str(views.anchor))
        status = "complete"
    finally:
        folder.write_summary(status, seconds=round(time.perf_counter() - began, 3))
    return counts


def _predict_into(
    model: Deltas,
    capture: Capture,
    views: ViewSet,
    folder: OutputFolder,
    config: PredictConfig,
) -> bool:
    """Write one view set's outputs; whether nothing could be triangulated."""
    started = time.perf_counter()
    frames = [capture.frame(id) for id in (views.anchor, *views.sources)]
    result = predict_frame(model, frames, config)
    valid = int(result.prediction.points.valid.sum())
    folder.write_frame(
        views.anchor,
        depth=result.depth,
        probability=result.confidence,
        points=result.points,
        colors=result.colors,
        record={
            "status": "ok" if valid else "no point triangulated",
            "sources": views.sources,
            "valid_points": valid,
            "seconds": round(time.perf_counter() - started, 4),
        },
    )
    return valid == 0
