"""How many times as far as the triangulated points of a map measured depth says that things are.

Measured depth sets maps right that are off as a whole, so a map that follows depth of a wrong unit
is as sure of itself as any. The points that were triangulated have not heard of it.
"""

import numpy as np
import torch
from numpy.typing import NDArray

from deltas_geom.cameras.pixels import resize_pixels
from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.measured import MeasuredDepth
from deltas_nets.predict.depth_map import KeypointDepths

__all__ = ["measured_factor"]

CELL = 16
"""Pixels that the network works at: points and measured depth are compared in squares so wide, in
which there is a point or two."""
LEAST = 5
"""Squares that both are in, for a median."""


def measured_factor(
    points: KeypointDepths, measured: MeasuredDepth, image_size: tuple[int, int]
) -> float | None:
    """The median of measured by triangulated depth; None where hardly any place has both.

    Args:
        points: of the anchor, whose matches alone tell their depth.
        measured: of the anchor, in the same unit.
        image_size: (height, width) that the pixels of measured depth are in.
    """
    pixels = resize_pixels(
        torch.from_numpy(measured.pixels), old_size=image_size, new_size=points.image_size
    )
    depth = points.depth.double().cpu().numpy()
    of_points = _cells(points.pixels.double().cpu(), points.image_size)[depth > 0]
    of_measured = _cells(pixels, points.image_size)
    both = np.intersect1d(of_points, of_measured)
    if len(both) < LEAST:
        return None
    triangulated = _medians(of_points, depth[depth > 0], both)
    return float(np.median(_medians(of_measured, measured.depth, both) / triangulated))


def _cells(pixels: torch.Tensor, image_size: tuple[int, int]) -> NDArray[np.int64]:
    """The number of the square ``(N,)`` in which each pixel is."""
    column, row = ((pixels + 0.5) / CELL).floor().long().unbind(dim=-1)
    cells: NDArray[np.int64] = (row * (image_size[1] // CELL + 1) + column).numpy()
    return cells


def _medians(cells: NDArray[np.int64], depth: FloatArray, wanted: NDArray[np.int64]) -> FloatArray:
    """The middle depth of each wanted square, all of which have some."""
    order = np.lexsort((depth, cells))
    first = np.searchsorted(cells[order], wanted, side="left")
    last = np.searchsorted(cells[order], wanted, side="right") - 1
    middle: FloatArray = depth[order][(first + last) // 2]
    return middle
