"""What keeps a matrix from being a pose."""

from typing import NamedTuple

import numpy as np

from deltas_nets.captures.frame import FloatArray

__all__ = ["NotRigid", "why_not_rigid"]

TOLERANCE = 2e-3
"""Largest entry of R^T R - I. Six digits after the point give 1e-5, 7-Scenes as published
1.5e-4; a scale of 0.1 %, the least that would matter to metric depth, gives 2e-3."""

ROUNDED = 2e-2
"""What two digits after the point give, at most: sqrt(3) / 100. Who prints so means a rotation."""


class NotRigid(NamedTuple):
    """Why a matrix is no pose.

    Attributes:
        what: what it does, after "the pose".
        remedy: what to do.
    """

    what: str
    remedy: str


def why_not_rigid(matrix: FloatArray) -> NotRigid | None:
    """Why a finite matrix is no rotation and translation; None if it is.

    Args:
        matrix: ``(3 or 4, 4)``.

    Example:
        >>> why_not_rigid(np.diag([1.0, 1, -1, 1])).what
        'mirrors: its rotation has determinant -1'
        >>> why_not_rigid(np.diag([2.5, 2.5, 2.5, 1])).what
        'scales by 2.5: the columns of its rotation have that length'
    """
    rotation, translation = matrix[:3, :3], matrix[:3, 3]
    last = matrix[3] if len(matrix) > 3 else np.array([0.0, 0, 0, 1])
    if np.abs(last - (0, 0, 0, 1)).max() > 1e-6:
        if not translation.any() and abs(last[3] - 1) <= 1e-6:
            what = "is transposed: its translation stands in the last row"
            return NotRigid(what, "write rows as columns, so that the last row is 0 0 0 1")
        row = " ".join(f"{value:g}" for value in last)
        return NotRigid(f"has the last row {row}, not 0 0 0 1", "write it as 0 0 0 1")
    with np.errstate(over="ignore", invalid="ignore"):
        square = rotation.T @ rotation
        scale = float(np.sqrt(np.trace(square) / 3))
        error = np.abs(square - np.eye(3)).max()
        shear = np.abs(square - scale**2 * np.eye(3)).max()
    if not error <= TOLERANCE:
        if 0 < scale < np.inf and shear <= TOLERANCE * scale**2:
            what = f"scales by {scale:.4g}: the columns of its rotation have that length"
            remedy = "divide the rotation by it, and a world-to-camera translation, too"
            return NotRigid(what, remedy)
        what = f"is not rigid: its rotation is off orthogonal by {error:.2g}"
        if error <= ROUNDED:
            return NotRigid(what, "write its numbers with six digits after the point, or more")
        return NotRigid(what, "write a rotation and a translation, without scale or shear")
    if np.linalg.det(rotation) < 0:
        what = "mirrors: its rotation has determinant -1"
        return NotRigid(what, "negate an axis of the camera, or of the world if it is left-handed")
    return None
