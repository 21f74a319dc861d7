"""Depth of another camera, moved to where the colour image sees it."""

import numpy as np
from numpy.typing import NDArray

from deltas_nets.captures.frame import Frame

__all__ = ["register_depth"]


def register_depth(frame: Frame) -> NDArray[np.float32]:
    """Warp a frame's depth into its colour camera.

    Each pixel of depth is a small square that faces the depth camera; it is drawn where the colour
    camera sees it, and the nearest surface wins. Lens distortion is not undone: the depth is that
    of an image without it.

    Args:
        frame: one with depth, ``depth_K`` and ``cam_from_depth``; None of either stands for the
            colour camera's.

    Returns:
        ``(H, W)`` metres along the colour camera's z at its image's own size, 0 where unknown.

    Raises:
        UserError: the depth cannot be read.
    """
    depth = frame.read_depth()
    K = frame.K if frame.depth_K is None else frame.depth_K
    cam_from_depth = np.eye(4) if frame.cam_from_depth is None else frame.cam_from_depth
    rows, columns = np.nonzero(depth)
    z = depth[rows, columns].astype(np.float64)
    inverse_K = np.linalg.inv(K)

    def seen(right: float, down: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        pixels = np.stack((columns + right, rows + down, np.ones(len(z))))
        points = cam_from_depth[:3, :3] @ (inverse_K @ pixels * z) + cam_from_depth[:3, 3:]
        ahead = np.where(points[2] > 0, points[2], np.inf)
        return frame.K[:2] @ np.vstack((points[:2] / ahead, np.ones(len(z)))), points[2]

    size = frame.image_size
    centre, depth_there = seen(0, 0)
    one, _ = seen(-0.5, -0.5)
    other, _ = seen(0.5, 0.5)
    low, high = np.minimum(one, other), np.maximum(one, other)
    # Pixels whose centres are inside of the square; the nearest one if none is.
    first, last = np.ceil(low - 1e-9), np.ceil(high - 1e-9) - 1
    empty = last < first
    first = np.where(empty, np.round(centre), first)
    last = np.where(empty, first, last)
    inside = (
        (depth_there > 0)
        & (last >= 0).all(0)
        & (first[0] < size[1])
        & (first[1] < size[0])
        & np.isfinite(first).all(0)
        & np.isfinite(last).all(0)
    )
    first, last, near = first[:, inside], last[:, inside], depth_there[inside]
    result = np.full(size, np.inf, dtype=np.float32)
    most = 1 + (last - first).max(axis=1, initial=0).astype(int)
    # A surface so near that its squares are larger is not a surface: it would take for ever.
    most = np.minimum(most, 16)
    for right in range(most[0]):
        for down in range(most[1]):
            x, y = first[0] + right, first[1] + down
            drawn = (x <= last[0]) & (y <= last[1]) & (x >= 0) & (y >= 0)
            drawn &= (x < size[1]) & (y < size[0])
            place = y[drawn].astype(int), x[drawn].astype(int)
            np.minimum.at(result, place, near[drawn].astype(np.float32))
    return np.where(np.isfinite(result), result, np.float32(0))
