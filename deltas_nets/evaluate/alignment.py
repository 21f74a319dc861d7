"""A map moved as a whole before it is scored, for what it is worth without its scale."""

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["Aligned", "Alignment", "align"]

Alignment = Literal["none", "median", "scale-and-shift"]
Map = NDArray[np.float32]


class Aligned(NamedTuple):
    """A map and how it was moved: ``scale * depth + shift``.

    Attributes:
        depth: as the map, metres; 0 where it has none.
        scale: without a unit.
        shift: metres.
    """

    depth: Map
    scale: float
    shift: float


def align(
    predicted: Map, truth: Map, kind: Alignment, *, depth_range: tuple[float, float]
) -> Aligned:
    """Move a map towards the truth, by the pixels where both are known and the truth is in range.

    Args:
        predicted: ``(H, W)`` metres; 0, negative or not finite is no prediction.
        truth: ``(H, W)`` metres; 0 is unknown.
        kind: "none" leaves it; "median" multiplies it by the median of truth / predicted;
            "scale-and-shift" by least squares of s * predicted + t - truth, in depth and not in its
            inverse. What would fall to or below 0 by a shift is set to the nearest depth that
            counts, so that it stays a prediction, and a wrong one.
        depth_range: (near, far) of the true depth that counts, metres.

    Source: Eigen et al., Depth map prediction from a single image (2014), for the median as in
    Zhou et al. (2017); Ranftl et al., Towards robust monocular depth estimation (2020), equation 3,
    for scale and shift, there in inverse depth.

    Example:
        >>> depth = np.array([[1.0, 2.0, 3.0]], dtype=np.float32)
        >>> align(depth, 2 * depth + 1, "scale-and-shift", depth_range=(0.5, 10)).depth
        array([[3., 5., 7.]], dtype=float32)
    """
    near, far = depth_range
    there = np.isfinite(predicted) & (predicted > 0)
    both = there & np.isfinite(truth) & (truth >= near) & (truth <= far)
    if kind == "none" or not both.any():
        return Aligned(predicted, 1.0, 0.0)
    # Predictions of any size, down to 1e-45, have a scale in float64.
    all_p = predicted.astype(np.float64)
    p, g = all_p[both], truth[both].astype(np.float64)
    if kind == "median":
        scale, shift = float(np.median(g / p)), 0.0
        moved = scale * all_p
    else:
        scale, shift = _least_squares(p, g)
        moved = np.maximum(scale * all_p + shift, 0)
        moved = np.where(moved > 0, moved, near)
    # What leaves the range of float32 stays a prediction, and a wrong one.
    ends = np.finfo(np.float32)
    moved = np.where(there, moved.clip(ends.smallest_subnormal, ends.max), 0)
    return Aligned(moved.astype(np.float32), scale, shift)


def _least_squares(p: NDArray[np.float64], g: NDArray[np.float64]) -> tuple[float, float]:
    """Scale and shift from p to g; of a constant p the shift alone, which is all it can tell."""
    p_mean, g_mean = float(p.mean()), float(g.mean())
    variance = float(((p - p_mean) ** 2).mean())
    if variance <= (1e-6 * p_mean) ** 2:
        return 1.0, g_mean - p_mean
    scale = float(((p - p_mean) * (g - g_mean)).mean()) / variance
    return scale, g_mean - scale * p_mean
