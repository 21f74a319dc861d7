"""Where up is in a capture's world, told from its cameras, as no file says it."""

import numpy as np

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import FloatArray

__all__ = ["up_of", "y_up_from_world"]

PITCH = 0.1
"""How much more level cameras are held from left to right than from front to back: a variance."""
LEAST = 0.2
"""Length of the mean of the cameras' own ups, below which they say nothing: they look down, say."""
Y_DOWN = np.diag([1.0, -1.0, -1.0])


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

    Of a world whose y is down it is the half turn around x, and of others the one nearest to it.
    """
    towards = Y_DOWN @ (up / np.linalg.norm(up))
    x, y, z = towards
    if y < -1 + 1e-9:  # y is up already
        return np.eye(3)
    # The shortest rotation from one unit vector to another, here to y, by Rodrigues' formula.
    cross = np.array([[0, -x, 0], [x, 0, z], [0, -z, 0]])
    turned: FloatArray = (np.eye(3) + cross + cross @ cross / (1 + y)) @ Y_DOWN
    return turned
