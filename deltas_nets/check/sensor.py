"""Sensor depth of frames, thinned, with the camera that measured it."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deltas_nets.captures.frame import FloatArray, Frame
from deltas_nets.captures.frames import Frames
from deltas_nets.check.rewrite import of_shape
from deltas_nets.errors import UserError

__all__ = ["Sensor", "sensors"]


class Sensor(NamedTuple):
    """What a depth sensor measured of a frame.

    Attributes:
        depth: ``(H, W)`` in the capture's unit, 0 where unknown.
        K: ``(3, 3)`` of that image, as the capture has it.
        cam_from_world: ``(4, 4)`` of the depth camera.
        image_K: ``(3, 3)`` of the colour image, at the depth image's size.
    """

    depth: NDArray[np.float32]
    K: FloatArray
    cam_from_world: FloatArray
    image_K: FloatArray


def sensors(frames: Frames, positions: list[int]) -> dict[int, Sensor]:
    """Depth by position; none of frames that have none that can be read."""
    found = {}
    for position in positions:
        frame = frames.at(position)
        if frame.depth_path is None:
            continue
        try:
            found[position] = _sensor(frame)
        except UserError:
            continue
    return found


def _sensor(frame: Frame) -> Sensor:
    depth = frame.read_depth()
    size = (depth.shape[0], depth.shape[1])
    image_K = of_shape(frame.K, frame.image_size, size)
    pose = frame.cam_from_world
    if frame.cam_from_depth is not None:
        pose = np.linalg.inv(frame.cam_from_depth) @ pose
    return Sensor(depth, image_K if frame.depth_K is None else frame.depth_K, pose, image_K)
