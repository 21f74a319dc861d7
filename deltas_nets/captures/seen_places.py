"""Which of some places in front of one camera other frames of a capture have in their images."""

import numpy as np
from numpy.typing import NDArray

from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.frames import Frames

__all__ = ["seen_places"]


def seen_places(
    frames: Frames,
    others: NDArray[np.intp],
    places: FloatArray,
    cam_from_world: FloatArray,
    *,
    nearest: float = 0.0,
) -> NDArray[np.bool_]:
    """Which frame sees which place, if nothing hides it.

    Args:
        frames: of the capture.
        others: ``(C,)`` positions of the frames that are asked.
        places: ``(3, P)`` in the axes of a camera.
        cam_from_world: ``(4, 4)`` of that camera.
        nearest: depth up to which a place counts as not seen.

    Returns:
        ``(C, P)``.
    """
    poses, rotation = frames.cam_from_world[others], cam_from_world[:3, :3]
    # Relative poses first: with the world's origin kilometres away the sums would cancel.
    turns = poses[:, :3, :3] @ rotation.T
    seen = turns @ places + (poses[:, :3, 3:] - turns @ cam_from_world[:3, 3:])
    projected = frames.K[others] @ seen
    depth = projected[:, 2]
    in_front = depth > nearest
    safe = np.where(in_front, depth, 1.0)
    column, row = projected[:, 0] / safe, projected[:, 1] / safe
    sizes = frames.image_sizes[others].astype(np.float64)
    inside = (np.abs(column - (sizes[:, 1:] - 1) / 2) <= sizes[:, 1:] / 2) & (
        np.abs(row - (sizes[:, :1] - 1) / 2) <= sizes[:, :1] / 2
    )
    visible: NDArray[np.bool_] = in_front & inside
    return visible
