"""A capture whose unit somebody knows, in metres."""

from dataclasses import replace

import numpy as np

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import FloatArray, Frame
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.scaled import scaled
from deltas_nets.errors import UserError

__all__ = ["in_metres"]

FLOATS = (".npy", ".npz", ".pfm", ".exr")
"""Suffixes of depth files that hold floats."""


def in_metres(capture: Capture, unit: float) -> Capture:
    """The capture with poses, points, ranges and depth in metres.

    Args:
        capture: in whatever unit.
        unit: metres that its unit is long.

    Raises:
        UserError: the unit is not positive and finite, or depth files hold floats, which no
            number of steps goes with.
    """
    if not (np.isfinite(unit) and unit > 0):
        raise UserError("a unit must be positive", f"--scale {unit:g}", "give metres")
    floats = [frame for frame in capture.frames.values() if _holds_floats(frame)]
    if floats and unit != 1:
        what = f"depth of {len(floats)} frames is in floats of the capture's unit"
        raise UserError(what, str(floats[0].depth_path), "scale the files, or leave depth out")
    moved = scaled(capture, unit)
    arrays = moved.frames.arrays
    cameras = tuple(
        camera._replace(
            depth_scale=camera.depth_scale / unit,
            cam_from_depth=_scaled(camera.cam_from_depth, unit),
        )
        for camera in arrays.cameras
    )
    frames = Frames(
        capture.frames.folder, arrays._replace(cameras=cameras), memory=capture.frames.memory
    )
    return replace(moved, frames=frames)


def _holds_floats(frame: Frame) -> bool:
    return frame.depth_path is not None and frame.depth_path.suffix.lower() in FLOATS


def _scaled(pose: FloatArray | None, unit: float) -> FloatArray | None:
    if pose is None:
        return None
    scaled = pose.copy()
    scaled[:3, 3] *= unit
    return scaled
