"""Which maps a map is compared with."""

import numpy as np
from numpy.typing import NDArray

from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.view_choice import spread_sources
from deltas_nets.fuse.depth_view import DepthView

__all__ = ["neighbours"]

MOST_CANDIDATES = 256
PROBES = 24
"""Rows and columns of pixels whose points are looked for in other frames."""
GOOD_BASELINE = 0.06
"""Of the depth. Maps of nearer frames err alike, and agree when they are wrong."""
LEAST_OVERLAP = 0.1


def neighbours(
    view: DepthView, frames: Frames, candidates: NDArray[np.intp], count: int
) -> list[int]:
    """Frames that see much of what a map shows, from different sides.

    Args:
        view: the map.
        frames: those of the capture.
        candidates: positions of frames that have maps, less the view's own.
        count: how many are wanted.

    Returns:
        At most ``count`` positions, best first; none where nothing overlaps.
    """
    points, depth = _probes(view)
    if depth == 0 or len(candidates) == 0:
        return []
    poses = frames.cam_from_world[candidates]
    centres = -(poses[:, :3, :3].transpose(0, 2, 1) @ poses[:, :3, 3:])[..., 0]
    pose = view.cam_from_world.cpu().numpy()
    offsets = (centres @ pose[:3, :3].T + pose[:3, 3]) / depth
    baseline = np.linalg.norm(offsets, axis=-1)
    nearest = np.argsort(baseline, kind="stable")[:MOST_CANDIDATES]
    candidates, offsets, baseline = candidates[nearest], offsets[nearest], baseline[nearest]
    overlap = _overlap(frames, candidates, points, pose)
    short = np.minimum(np.log(np.maximum(baseline, 1e-6) / GOOD_BASELINE), 0)
    score = 2 * np.log(np.maximum(overlap, 1e-3)) - 0.5 * short**2
    fit = overlap >= LEAST_OVERLAP
    candidates, score, offsets = candidates[fit], score[fit], offsets[fit]
    return [int(candidates[place]) for place in spread_sources(score, offsets, count)]


def _probes(view: DepthView) -> tuple[FloatArray, float]:
    """Some points ``(3, P)`` in the camera's axes, and their median depth."""
    height, width = view.image_size
    every = (slice(None, None, 1 + height // PROBES), slice(None, None, 1 + width // PROBES))
    points = view.points()[every].reshape(-1, 3).double().cpu().numpy()
    points = points[points[:, 2] > 0]
    return points.T, float(np.median(points[:, 2])) if len(points) else 0.0


def _overlap(
    frames: Frames, candidates: NDArray[np.intp], points: FloatArray, pose: FloatArray
) -> FloatArray:
    """Part of the points that each candidate has in its image, (C,)."""
    poses = frames.cam_from_world[candidates]
    # Relative poses first: with the world's origin kilometres away the sums would cancel.
    turns = poses[:, :3, :3] @ pose[:3, :3].T
    seen = turns @ points + (poses[:, :3, 3:] - turns @ pose[:3, 3:])
    projected = frames.K[candidates] @ seen
    ahead = projected[:, 2] > 0
    pixels = projected[:, :2] / np.where(ahead, projected[:, 2], 1.0)[:, None]
    size = frames.image_sizes[candidates][:, ::-1, None]
    inside = (pixels >= -0.5) & (pixels < size - 0.5)
    part: FloatArray = (ahead & inside.all(axis=1)).mean(axis=-1)
    return part
