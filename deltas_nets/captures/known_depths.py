"""How far away a frame's surfaces are, as far as the capture knows without any network."""

import numpy as np

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.seen_places import in_images

__all__ = [
    "depths_of_sensor",
    "farthest_depth",
    "points_in_view",
    "typical_depths",
]

ENOUGH = 20
"""Points that tell what a frame shows; fewer may all be on one thing."""
SOME = 2000
"""Pixels of sensor depth that are looked at."""


def points_in_view(capture: Capture, position: int, *, least: int = ENOUGH) -> FloatArray | None:
    """Sparse points that a frame sees, or would see where no one says so, in its camera's axes.

    Args:
        capture: the frames.
        position: of the frame among them.
        least: fewer are none.

    Returns:
        ``(D, 3)`` in front of it; None where there are too few.
    """
    points = capture.points
    if points is None:
        return None
    told = len(points.seen.frame) > 0
    xyz = points.xyz[capture.points_of_frame[position]] if told else points.xyz
    pose = capture.frames.cam_from_world[position]
    found = xyz @ pose[:3, :3].T + pose[:3, 3]
    found = found[found[:, 2] > 0]
    if not told:
        found = found[in_images(capture.frames, np.array([position]), found.T[None])[0]]
    return found if len(found) >= least else None


def depths_of_sensor(capture: Capture, position: int) -> FloatArray | None:
    """Some of the depths that a sensor measured.

    Raises:
        UserError: the file cannot be read.
    """
    frame = capture.frames.at(position)
    if frame.depth_path is None:
        return None
    depth = frame.read_depth()
    known = depth[depth > 0].astype(np.float64)
    return known[:: 1 + len(known) // SOME] if len(known) >= ENOUGH else None


def typical_depths(capture: Capture) -> FloatArray:
    """``(F,)`` median depth of what each frame shows, by its sparse points; NaN where unknown."""
    found = np.full(len(capture.frames), np.nan)
    if capture.points is not None:
        for position in range(len(found)):
            points = points_in_view(capture, position)
            if points is not None:
                found[position] = np.median(points[:, 2])
    return found


def farthest_depth(capture: Capture) -> float:
    """The largest depth that a frame's sparse points or stated range reach, but for a few; or 0."""
    far = 0.0 if capture.depth_ranges is None else float(capture.depth_ranges[:, 1].max())
    if capture.points is not None:
        for position in range(len(capture.frames)):
            points = points_in_view(capture, position)
            if points is not None:
                far = max(far, float(np.percentile(points[:, 2], 98)))
    return far
