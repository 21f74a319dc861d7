"""Key frames and measurement frames of DeepVideoMVS: an online system that looks back only.

Source: after Duzceker et al., DeepVideoMVS: Multi-view stereo on video with recurrent
spatio-temporal fusion (CVPR 2021), and Hou et al., Multi-view stereo by temporal nonparametric
fusion (ICCV 2019), whose distance it is. The rule as it stands here was not compared with their
program.
"""

from collections import deque

import numpy as np

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.errors import UserError

__all__ = ["deep_video_view_sets", "penalty", "pose_distance"]

KEY_DISTANCE = 0.1
"""From the last key frame to the next: metres and turn together."""
BUFFER = 30
"""Key frames that are remembered."""
BEST_BASELINE = 0.15
"""Metres to a measurement frame."""
NARROW = 5.0
"""How much worse a baseline that is too short is than one that is too long."""


def deep_video_view_sets(capture: Capture, num_views: int) -> tuple[ViewSet, ...]:
    """Each key frame with the best of those before it.

    A frame is a key frame if it is 0.1 or farther from the last one. Its sources are the
    ``num_views - 1`` of the 30 before it with the smallest :func:`penalty`, best first; the first
    key frames have fewer, and the very first, which has none, is no anchor.

    Args:
        capture: the frames in the order in which they were taken.
        num_views: the anchor and its measurement frames.

    Raises:
        UserError: fewer than two frames are key frames.
    """
    poses = capture.frames.cam_from_world
    buffer: deque[int] = deque(maxlen=BUFFER)
    sets = []
    for place, pose in enumerate(poses):
        if buffer and pose_distance(pose, poses[buffer[-1]]) < KEY_DISTANCE:
            continue
        by_penalty = sorted(buffer, key=lambda other: penalty(pose, poses[other]))
        if by_penalty:
            sources = tuple(map(capture.frames.id_at, by_penalty[: num_views - 1]))
            sets.append(ViewSet(capture.frames.id_at(place), sources))
        buffer.append(place)
    if not sets:
        what = f"no frame is {KEY_DISTANCE:g} m or more from the first"
        raise UserError(what, capture.path, "use --protocol chosen")
    return tuple(sets)


def pose_distance(one: FloatArray, other: FloatArray) -> float:
    """How far two cameras are apart: sqrt(|t|^2 + 2/3 tr(I - R)) of their relative pose.

    Args:
        one: ``(4, 4)`` cam_from_world, metres.
        other: of the other camera.

    Example:
        >>> half_turn = np.diag([-1.0, -1, 1, 1])
        >>> round(pose_distance(np.eye(4), half_turn) ** 2, 9)
        2.666666667
    """
    baseline, turn = _baseline_and_turn(one, other)
    return float(np.hypot(baseline, turn))


def penalty(one: FloatArray, other: FloatArray) -> float:
    """How bad a measurement frame is: far from 15 cm of baseline, or turned.

    Args:
        one: ``(4, 4)`` cam_from_world of the key frame, metres.
        other: of the measurement frame.
    """
    baseline, turn = _baseline_and_turn(one, other)
    off = (baseline - BEST_BASELINE) ** 2
    return (NARROW * off if baseline < BEST_BASELINE else off) + turn**2


def _baseline_and_turn(one: FloatArray, other: FloatArray) -> tuple[float, float]:
    relative = one @ np.linalg.inv(other)
    trace = min(3.0, float(np.trace(relative[:3, :3])))
    return float(np.linalg.norm(relative[:3, 3])), (2 / 3 * (3 - trace)) ** 0.5
