"""A capture in another unit."""

from dataclasses import replace

import numpy as np

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import FloatArray, Frame
from deltas_nets.captures.frames import Camera, Frames
from deltas_nets.errors import UserError

__all__ = ["in_metres", "moved_frame", "scaled"]


def scaled(
    capture: Capture, factor: float, *, depth_factor: float = 1.0, metric: bool = True
) -> Capture:
    """The same world, a unit of which was ``factor`` new ones.

    Args:
        capture: the frames.
        factor: positive.
        depth_factor: the same of the unit of sensor depth; 1 where that is in the new unit already.
        metric: whether the new unit is the metre.
    """
    frames, points, ranges = capture.frames, capture.points, capture.depth_ranges
    arrays = frames.arrays._replace(
        cam_from_world=_moved(frames.cam_from_world, factor),
        cameras=tuple(_with_depth(camera, depth_factor) for camera in frames.arrays.cameras),
    )
    return replace(
        capture,
        frames=Frames(frames.folder, arrays, memory=frames.memory),
        metric=metric,
        scaled_by=factor * capture.scaled_by,
        depth_scaled_by=depth_factor * capture.depth_scaled_by,
        points=None if points is None else points._replace(xyz=points.xyz * factor),
        depth_ranges=None if ranges is None else ranges * factor,
    )


def in_metres(capture: Capture, unit: float) -> Capture:
    """The capture with poses, points, ranges and sensor depth in metres.

    Args:
        capture: in whatever unit, its sensor depth too.
        unit: metres that its unit is long.

    Raises:
        UserError: the unit is not positive and finite.
    """
    if not (np.isfinite(unit) and unit > 0):
        raise UserError("a unit must be positive", f"--scale {unit:g}", "give metres")
    return scaled(capture, unit, depth_factor=unit)


def moved_frame(frame: Frame, factor: float) -> Frame:
    """A frame where it stands in a world of another unit; its depth stays in the old one."""
    if factor == 1:
        return frame
    return replace(frame, cam_from_world=_moved(frame.cam_from_world, factor))


def _with_depth(camera: Camera, factor: float) -> Camera:
    pose = camera.cam_from_depth
    return camera._replace(
        depth_scale=camera.depth_scale / factor,
        depth_unit=camera.depth_unit * factor,
        cam_from_depth=None if pose is None else _moved(pose, factor),
    )


def _moved(poses: FloatArray, factor: float) -> FloatArray:
    """Poses ``(*B, 4, 4)`` in a world of another unit."""
    moved = poses.copy()
    moved[..., :3, 3] *= factor
    return moved
