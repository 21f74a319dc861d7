"""One picture of a prediction: what was matched where, what came out, how wrong it is."""

from pathlib import Path

import matplotlib
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from deltas_geom import epipolar_segments
from deltas_nets.outputs.atomic_files import write_atomically
from deltas_nets.predict.ours import FrameDepth

DEPTH_COLORS = "turbo_r"
NUM_LINES = 14


def draw_prediction(
    path: Path,
    result: FrameDepth,
    truth: NDArray[np.float32],
    *,
    depth_range: tuple[float, float],
    title: str,
) -> None:
    """Write a PNG with six panels: matches in both views, sparse, dense, truth, error.

    Args:
        path: of the picture.
        result: a prediction from the anchor and at least one source; the first is drawn.
        truth: ``(H, W)`` true depth at the size of ``result.map.depth``, 0 = unknown.
        depth_range: of the search: the segments' ends.
        title: above the panels.
    """
    figure = Figure(figsize=(15, 7.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 3)
    figure.suptitle(title)
    known = truth > 0
    limits = np.percentile(np.log(truth[known]), (1, 99))
    _draw_matches(axes[0, 0], axes[0, 1], result, depth_range)
    _draw_sparse(axes[0, 2], result, limits)

    def draw_depth(axis: Axes, depth: NDArray[np.float32], name: str) -> None:
        shown = np.ma.masked_where(depth <= 0, np.log(np.where(depth > 0, depth, 1)))
        axis.imshow(shown, cmap=DEPTH_COLORS, vmin=limits[0], vmax=limits[1])
        axis.set_title(name)

    draw_depth(axes[1, 0], result.map.depth, "dense depth")
    draw_depth(axes[1, 1], truth, "true depth")
    error = np.ma.masked_where(~known, np.abs(result.map.depth - truth) / np.where(known, truth, 1))
    errors = error.compressed()
    drawn = axes[1, 2].imshow(100 * error, cmap="magma", vmin=0, vmax=20)
    axes[1, 2].set_title(
        f"error: mean {100 * errors.mean():.1f} %, median {100 * np.median(errors):.1f} %"
    )
    figure.colorbar(drawn, ax=axes[1, 2], label="relative error, %", shrink=0.8)
    ticks = np.linspace(limits[0], limits[1], 5)
    scale = matplotlib.cm.ScalarMappable(matplotlib.colors.Normalize(*limits), DEPTH_COLORS)
    bar = figure.colorbar(scale, ax=axes[1, 1], ticks=ticks, shrink=0.8)
    bar.ax.set_yticklabels([f"{depth:.1f} m" for depth in np.exp(ticks)])
    for axis in axes.flat:
        axis.set_axis_off()
    write_atomically(path, lambda file: figure.savefig(file, format="png", dpi=110))


def _draw_matches(
    anchor: Axes, source: Axes, result: FrameDepth, depth_range: tuple[float, float]
) -> None:
    """A keypoint, its segment in the source and its match there have the same colour."""
    prediction, images = result.prediction, result.images.permute(0, 2, 3, 1).numpy()
    keypoints = prediction.keypoints.pixels.cpu()
    order = prediction.evidence.confidence.cpu().argsort(descending=True)
    # Every so many of the more confident half: spread over the picture, and worth a look.
    chosen = order[: len(order) // 2 : max(1, len(order) // 2 // NUM_LINES)]
    segments = epipolar_segments(
        result.views, keypoints[chosen], depth_range=depth_range, image_size=images.shape[1:3]
    )
    matches = prediction.matches.pixels[1].cpu()[chosen]
    colors = matplotlib.colormaps["hsv"](np.linspace(0, 0.92, len(chosen)))
    anchor.imshow(images[0])
    x, y = keypoints.numpy().T
    anchor.scatter(x, y, s=6, c="white", edgecolors="black", linewidths=0.4)
    anchor.scatter(x[chosen], y[chosen], s=34, c=colors, edgecolors="black")
    anchor.set_title(f"anchor, {len(keypoints)} points")
    source.imshow(images[1])
    ends = torch.stack([segments.start[0], segments.end[0]], dim=1).numpy()
    for color, line, shown in zip(colors, ends, segments.visible[0], strict=True):
        if shown:
            source.plot(*line.T, color=color, linewidth=1.2)
    source.scatter(matches[:, 0], matches[:, 1], s=34, c=colors, edgecolors="black")
    source.set_title("first source: segments and matches")


def _draw_sparse(axis: Axes, result: FrameDepth, limits: NDArray[np.float64]) -> None:
    prediction = result.prediction
    grey = result.images[0].mean(dim=0).numpy()
    axis.imshow(grey, cmap="gray", vmin=-0.5, vmax=1.5)
    valid = prediction.points.valid.cpu()
    pixels = prediction.keypoints.pixels.cpu()[valid]
    depth = prediction.points.depth[0].cpu()[valid]
    axis.scatter(
        pixels[:, 0],
        pixels[:, 1],
        c=depth.log(),
        s=14,
        cmap=DEPTH_COLORS,
        vmin=limits[0],
        vmax=limits[1],
        linewidths=0,
    )
    axis.set_title(f"sparse depth, {int(valid.sum())} triangulated points")
