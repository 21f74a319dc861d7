"""Points that the program which found the poses triangulated, and where frames see them."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deltas_nets.captures.frame import FloatArray

__all__ = ["Observations", "SparsePoints"]


class Observations(NamedTuple):
    """T observations, in any order.

    Attributes:
        point: ``(T,)`` position of the point.
        frame: ``(T,)`` position of the frame in the capture's frames.
        pixels: ``(T, 2)`` in the image file, pixel centres at integers, lens not undone.
    """

    point: NDArray[np.int64]
    frame: NDArray[np.int64]
    pixels: FloatArray

    @classmethod
    def none(cls) -> "Observations":
        """No observation."""
        nothing = np.zeros(0, dtype=np.int64)
        return cls(nothing, nothing, np.zeros((0, 2)))

    def kept(self, frames: NDArray[np.bool_]) -> "Observations":
        """Those of the frames ``(F,)`` that are kept, whose positions change."""
        position = np.cumsum(frames) - 1
        seen = frames[self.frame]
        return Observations(self.point[seen], position[self.frame[seen]], self.pixels[seen])


class SparsePoints(NamedTuple):
    """P points.

    Attributes:
        xyz: ``(P, 3)`` in the capture's world and unit.
        rgb: ``(P, 3)``.
        error: ``(P,)`` px of reprojection, as stated; NaN where it is not.
        seen: the observations; none where the format has none.
    """

    xyz: FloatArray
    rgb: NDArray[np.uint8]
    error: FloatArray
    seen: Observations
