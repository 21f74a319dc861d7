"""Which places frames of a capture have in their images, through the lenses that they have."""

import numpy as np
import torch
from numpy.typing import NDArray

from deltas_geom import Lens
from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.straight import WIDEST

__all__ = ["in_images", "seen_places"]


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
    return in_images(frames, others, seen, nearest=nearest)


def in_images(
    frames: Frames, positions: NDArray[np.intp], points: FloatArray, *, nearest: float = 0.0
) -> NDArray[np.bool_]:
    """Which points frames have in their images; of a lens, in what is made straight of it.

    Args:
        frames: of the capture.
        positions: ``(C,)`` of the frames that are asked.
        points: ``(C, 3, P)`` in the axes of each one's camera.
        nearest: depth up to which a point is not seen.

    Returns:
        ``(C, P)``.
    """
    projected = frames.K[positions] @ points
    depth = projected[:, 2]
    visible: NDArray[np.bool_] = depth > nearest
    pixels = projected[:, :2] / np.where(visible, depth, 1.0)[:, None]
    cameras = [frames.arrays.cameras[camera] for camera in frames.arrays.camera_of[positions]]
    # A call for all lenses of a model: frames may have a camera each.
    for model in {camera.lens.model for camera in cameras if camera.lens is not None}:
        bent = {n: c.lens for n, c in enumerate(cameras) if c.lens and c.lens.model == model}
        K = torch.from_numpy(frames.K[positions[list(bent)]])
        coefficients = torch.tensor([lens.coefficients for lens in bent.values()]).to(K)
        mine = points[list(bent)]
        found = Lens(K, coefficients, model).project(torch.from_numpy(mine.swapaxes(1, 2)))
        pixels[list(bent)] = found.pixels.numpy().swapaxes(1, 2)
        shown = mine[:, 2] > WIDEST * np.linalg.norm(mine, axis=1)
        visible[list(bent)] &= found.valid.numpy() & shown
    width_height = frames.image_sizes[positions].astype(np.float64)[:, ::-1, None]
    inside = np.abs(pixels - (width_height - 1) / 2) <= width_height / 2
    return visible & inside.all(axis=1)
