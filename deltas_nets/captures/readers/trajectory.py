"""What was recorded at times of its own: which is nearest to another time, and poses between."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.rigid import rigid
from deltas_nets.captures.rotations import rotations_of

__all__ = ["GAP", "Trajectory", "nearest_stamps"]

GAP = 0.1
"""Seconds between two poses over which a camera moves evenly enough to interpolate."""
SAME = 0.002
"""Seconds from a pose that need no interpolation: 2 mm at 1 m/s."""


class Trajectory(NamedTuple):
    """Camera-to-world poses in the order of their stamps.

    Attributes:
        stamps: ``(P,)`` seconds.
        centres: ``(P, 3)``.
        quaternions: ``(P, 4)`` with w first.
    """

    stamps: FloatArray
    centres: FloatArray
    quaternions: FloatArray

    def poses_at(self, stamps: FloatArray, *, gap: float = GAP) -> FloatArray:
        """World-from-camera between the poses before and after.

        Args:
            stamps: ``(F,)`` seconds.
            gap: seconds between two poses over which to interpolate.

        Returns:
            ``(F, 4, 4)``; NaN where no poses are near.
        """
        last = len(self.stamps) - 1
        after = np.searchsorted(self.stamps, stamps).clip(0, last)
        before = (after - 1).clip(0, last)
        between = self.stamps[after] - self.stamps[before]
        part = (stamps - self.stamps[before]) / np.where(between > 0, between, 1)
        within = (between <= gap) & (part >= 0) & (part <= 1)
        # Poses of key frames alone are far apart, but at the stamps of their images.
        to_after = np.abs(stamps - self.stamps[after])
        nearer = np.where(to_after < np.abs(part * between), after, before)
        at_one = np.abs(stamps - self.stamps[nearer]) <= SAME
        part = np.where(within, part, (nearer == after) & (after > before))
        part = np.where(within | at_one, part, np.nan)[:, None]
        centres = (1 - part) * self.centres[before] + part * self.centres[after]
        turns = _slerp(self.quaternions[before], self.quaternions[after], part)
        return np.stack(
            [rigid(R, t) for R, t in zip(rotations_of(turns), centres, strict=True)]
        ).reshape(-1, 4, 4)


def _slerp(first: FloatArray, last: FloatArray, part: FloatArray) -> FloatArray:
    with np.errstate(all="ignore"):
        first = first / np.linalg.norm(first, axis=1, keepdims=True)
        last = last / np.linalg.norm(last, axis=1, keepdims=True)
        cosine = (first * last).sum(axis=1, keepdims=True)
        last, cosine = np.where(cosine < 0, -last, last), np.abs(cosine).clip(0, 1)
        angle = np.arccos(cosine)
        # Where the sine has no digits left, the chord is the arc.
        near = angle < 1e-6
        sine = np.where(near, 1, np.sin(angle))
        a = np.where(near, 1 - part, np.sin((1 - part) * angle) / sine)
        b = np.where(near, part, np.sin(part * angle) / sine)
    return a * first + b * last


def nearest_stamps(stamps: FloatArray, others: FloatArray, *, apart: float) -> NDArray[np.int64]:
    """The position of the nearest of other stamps ``(O,)``, in order; -1 where none is near.

    Args:
        stamps: ``(F,)`` seconds.
        others: ``(O,)`` seconds, in order.
        apart: seconds between two at most.

    Returns:
        ``(F,)``.
    """
    if not len(others):
        return np.full(len(stamps), -1)
    after = np.searchsorted(others, stamps).clip(0, len(others) - 1)
    before = (after - 1).clip(0)
    nearer = np.where(
        np.abs(others[after] - stamps) < np.abs(others[before] - stamps), after, before
    )
    return np.where(np.abs(others[nearer] - stamps) <= apart, nearer, -1)
