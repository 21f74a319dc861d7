"""Which maps a map is compared with."""

import numpy as np
from numpy.typing import NDArray

from deltas_nets.captures.centres import camera_centres
from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.seen_places import seen_places
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
    centres = camera_centres(poses)
    pose = view.cam_from_world.cpu().numpy()
    offsets = (centres @ pose[:3, :3].T + pose[:3, 3]) / depth
    baseline = np.linalg.norm(offsets, axis=-1)
    nearest = np.argsort(baseline, kind="stable")[:MOST_CANDIDATES]
    candidates, offsets, baseline = candidates[nearest], offsets[nearest], baseline[nearest]
    overlap = seen_places(frames, candidates, points, pose).mean(axis=-1)
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
