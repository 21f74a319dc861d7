"""A capture in another unit."""

from dataclasses import replace

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frames import Frames

__all__ = ["scaled"]


def scaled(capture: Capture, factor: float, *, metric: bool = True) -> Capture:
    """The same world, a unit of which was ``factor`` new ones.

    Depth files stay as they are: what a sensor measured is in metres.

    Args:
        capture: the frames.
        factor: positive.
        metric: whether the new unit is the metre.
    """
    frames, points, ranges = capture.frames, capture.points, capture.depth_ranges
    poses = frames.cam_from_world.copy()
    poses[:, :3, 3] *= factor
    arrays = frames.arrays._replace(cam_from_world=poses)
    return replace(
        capture,
        frames=Frames(frames.folder, arrays, memory=frames.memory),
        metric=metric,
        scaled_by=factor * capture.scaled_by,
        points=None if points is None else points._replace(xyz=points.xyz * factor),
        depth_ranges=None if ranges is None else ranges * factor,
    )
