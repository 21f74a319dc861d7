"""Rotations with translations as matrices, in NumPy."""

import numpy as np

from deltas_nets.captures.frame import FloatArray

__all__ = ["rigid", "rigid_inverse"]


def rigid(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """``(4, 4)`` from ``(3, 3)`` and ``(3,)``."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return matrix


def rigid_inverse(matrix: FloatArray) -> FloatArray:
    """The inverse of a rigid ``(4, 4)``."""
    back = matrix[:3, :3].T
    return rigid(back, -back @ matrix[:3, 3])
