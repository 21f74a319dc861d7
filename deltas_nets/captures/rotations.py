"""Rotations as quaternions and as matrices, in NumPy."""

import numpy as np

from deltas_nets.captures.frame import FloatArray

__all__ = ["quaternions_of", "rotations_of"]


def rotations_of(quaternions: FloatArray) -> FloatArray:
    """Rotation matrices of quaternions of any length but 0.

    Args:
        quaternions: ``(*B, 4)``, w first.

    Returns:
        ``(*B, 3, 3)``; NaN where a quaternion has no finite length above 0.

    Example:
        >>> rotations_of(np.array([1.0, 1, 0, 0])).round(3).tolist()
        [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
    """
    with np.errstate(all="ignore"):
        largest = np.abs(quaternions).max(axis=-1, keepdims=True)
        # By the largest first: squares of huge or tiny numbers leave float64.
        scaled = quaternions / largest
        w, x, y, z = np.moveaxis(scaled / np.linalg.norm(scaled, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternions_of(rotations: FloatArray) -> FloatArray:
    """Unit quaternions of rotation matrices.

    Args:
        rotations: ``(*B, 3, 3)``.

    Returns:
        ``(*B, 4)``, w first and not negative.

    Source: I. Bar-Itzhack, New method for extracting the quaternion from a rotation matrix,
    Journal of Guidance, Control, and Dynamics 23 (2000): an eigenvector, exact at any angle.

    Example:
        >>> quaternions_of(np.diag([1.0, -1, -1])).round(3).tolist()
        [0.0, 1.0, 0.0, 0.0]
    """
    r = rotations
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (
        [r[..., row, column] for column in range(3)] for row in range(3)
    )
    upper = [
        [xx + yy + zz, zy - yz, xz - zx, yx - xy],
        [zy - yz, xx - yy - zz, yx + xy, xz + zx],
        [xz - zx, yx + xy, yy - xx - zz, zy + yz],
        [yx - xy, xz + zx, zy + yz, zz - xx - yy],
    ]
    symmetric = np.stack([np.stack(row, axis=-1) for row in upper], axis=-2)
    q: FloatArray = np.linalg.eigh(symmetric)[1][..., -1]
    return np.where(q[..., :1] < 0, -q, q) + 0.0
