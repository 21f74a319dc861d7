"""Cameras of a capture in a few numbers, which tell whether another has the same but for rounding.

A hash would tell whether they are the same to the last digit, which poses seldom are after they
were written in another format and read again: one that is inverted twice is off by 1e-16. Sums of
all numbers, each times a weight of its own, are off by as little then, and by more where a camera
is another, however the numbers of several balance each other.
"""

import hashlib
from typing import Any

import numpy as np

from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.frames import Camera, Frames

__all__ = ["are_sums_of", "camera_sums"]

COUNT = 8
"""Sums of the same numbers, of other weights."""
TOLERANCE = 1e-12
"""Share of the length of all numbers, as a vector: rounding comes to a hundredth of it in captures
of 10 000 frames, and a focal length of 500 px that is off by 1e-5 px to a hundred times as much."""


def camera_sums(frames: Frames) -> dict[str, Any]:
    """Ids, sizes and kinds of lenses as a hash, and sums of all numbers, JSON-ready."""
    said = " ".join(
        f"{id} {size[0]}x{size[1]} {camera.lens.model if camera.lens else ''}"
        for id, size, camera in zip(frames, frames.image_sizes, _cameras(frames), strict=True)
    )
    sums = [(_weights(part.size) @ part.ravel()).tolist() for part in _parts(frames)]
    return {"frames": hashlib.sha256(said.encode()).hexdigest(), "sums": sums}


def are_sums_of(recorded: object, frames: Frames) -> bool:
    """Whether what `camera_sums` said of a capture is so of these frames, but for rounding.

    Args:
        recorded: from a file, whatever it holds.
        frames: of the capture in question.
    """
    mine = camera_sums(frames)
    if not isinstance(recorded, dict) or recorded.get("frames") != mine["frames"]:
        return False
    try:
        theirs = np.array(recorded.get("sums"), dtype=np.float64)
    except (TypeError, ValueError):
        return False
    if theirs.shape != (len(mine["sums"]), COUNT):
        return False
    lengths = np.array([np.linalg.norm(part) for part in _parts(frames)])
    apart = np.abs(theirs - np.array(mine["sums"])).max(axis=1)
    return bool((apart <= TOLERANCE * lengths).all())


def _parts(frames: Frames) -> tuple[FloatArray, ...]:
    """Numbers of one size each, so that far positions do not hide a rotation that is another."""
    poses = frames.cam_from_world
    lenses = [camera.lens.coefficients for camera in _cameras(frames) if camera.lens]
    coefficients = np.array([number for lens in lenses for number in lens], dtype=np.float64)
    return poses[:, :3, :3], poses[:, :3, 3], frames.K, coefficients


def _cameras(frames: Frames) -> list[Camera]:
    """The camera of each frame."""
    return [frames.arrays.cameras[position] for position in frames.arrays.camera_of]


def _weights(count: int) -> FloatArray:
    """``(COUNT, count)``: waves of lengths that do not fit each other, the same on any machine."""
    frequency = np.sqrt(np.array([2.0, 3, 5, 7, 11, 13, 17, 19]))[:COUNT, None]
    weights: FloatArray = np.sin(frequency * np.arange(1, count + 1))
    return weights
