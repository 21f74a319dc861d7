"""Where up is in a capture's world, told from its cameras, as no file says it."""

import numpy as np

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import FloatArray

__all__ = ["up_of", "y_up_from_world"]

PITCH = 0.1
"""How much more level cameras are held from left to right than from front to back: a variance."""
LEAST = 0.2
"""Length of the mean of the cameras' own ups, below which they say nothing: they look down, say."""
TURNS = np.array(
    [
        [[0.0, -1, 0], [1, 0, 0], [0, 0, 1]],
        [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
    ]
)
"""Rotations that turn x, y and z to y; the other way round all rows but that of their axis."""


def up_of(capture: Capture) -> FloatArray:
    """``(3,)`` unit vector that points up in the world, as photos are taken upright.

    It is the mean of what is up in the images, but rather level to their rows: people look up and
    down, and hold the horizon level. Where the images say nothing, y is taken to be down.
    """
    rotations = capture.frames.cam_from_world[:, :3, :3]
    rows, up = rotations[:, 0], -rotations[:, 1].mean(axis=0)
    if not np.linalg.norm(up) > LEAST:
        return np.array([0.0, -1.0, 0.0])
    level: FloatArray = np.linalg.solve(rows.T @ rows / len(rows) + PITCH * np.eye(3), up)
    return level / np.linalg.norm(level)


def y_up_from_world(up: FloatArray) -> FloatArray:
    """``(3, 3)`` rotation that turns up to +y: glTF's axes.

    The axis of the world that is nearest to up is turned there, about x if it can be, and then the
    little that is left, on the shortest way: a camera that is held askew does not spin the world.
    """
    up = up / np.linalg.norm(up)
    axis = int(np.abs(up).argmax())
    turn: FloatArray = np.sign(up[axis]) * TURNS[axis]
    turn[2 if axis == 0 else 0] = np.abs(turn[2 if axis == 0 else 0])
    x, y, z = turn @ up
    # Rodrigues' formula; the angle is 55 degrees at most.
    cross = np.array([[0, -x, 0], [x, 0, z], [0, -z, 0]])
    left: FloatArray = np.eye(3) + cross + cross @ cross / (1 + y)
    return left @ turn
