"""Intrinsics that a user states: numbers as OpenCV orders them, a matrix, or a camera by name."""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from deltas_nets.captures.frame import FloatArray, Lens
from deltas_nets.errors import UserError

__all__ = ["KNOWN_CAMERAS", "Intrinsics"]

_OPTION = "--intrinsics"
_COUNTS = (4, 8, 9, 12)

_FREIBURG1 = (
    517.306408, 516.469215, 318.643040, 255.313989,
    0.262383, -0.953104, -0.005358, 0.002628, 1.163314,
)  # fmt: skip
_FREIBURG2 = (
    520.908620, 521.007327, 325.141442, 249.701764,
    0.231222, -0.784899, -0.003257, -0.000105, 0.917205,
)  # fmt: skip
_FREIBURG3 = (535.4, 539.2, 320.1, 247.6)

KNOWN_CAMERAS = {"freiburg1": _FREIBURG1, "freiburg2": _FREIBURG2, "freiburg3": _FREIBURG3}
"""fx fy cx cy k1 k2 p1 p2 k3 of the colour cameras of TUM RGB-D, as its page on intrinsics
publishes them. Images of freiburg3 are undistorted already, and depth of all three is already
scaled by what the calibration found (1.035, 1.031, 1)."""


class Intrinsics(NamedTuple):
    """A camera matrix for images at their own size, and a lens.

    Attributes:
        K: ``(3, 3)``, pixel centres at integers.
        lens: None where straight lines are straight.
    """

    K: FloatArray
    lens: Lens | None

    @classmethod
    def parse(cls, text: str, where: str | Path = _OPTION) -> "Intrinsics":
        """Intrinsics in words.

        Args:
            text: ``fx fy cx cy``, then ``k1 k2 p1 p2``, ``k3`` and ``k4 k5 k6`` if there are any
                (as OpenCV orders them), between spaces or commas; or a matrix of 3 rows; or the
                name of a camera in `KNOWN_CAMERAS`, which ``fr1`` is short for.
            where: the option or the file that holds it, for errors.

        Raises:
            UserError: it is none of these, or no camera.

        Example:
            >>> Intrinsics.parse("500, 500, 320, 240").K[0].tolist()
            [500.0, 0.0, 320.0]
            >>> Intrinsics.parse("fr1").lens.model
            'FULL_OPENCV'
        """
        known = named_camera(text.strip())
        if known is not None:
            return known
        remedy = "give fx fy cx cy and, of a lens, k1 k2 p1 p2 k3; or "
        remedy += ", ".join(KNOWN_CAMERAS)
        words = text[:4096].replace(",", " ").replace(";", " ").split()
        try:
            numbers = np.array([float(word) for word in words])
        except ValueError as error:
            wrong = str(error).partition(": ")[2][:40]
            raise UserError(f"intrinsics hold {wrong}, no number", where, remedy) from error
        skew = 0.0
        if _is_matrix(numbers):
            skew, numbers = float(numbers[1]), numbers[[0, 4, 2, 5]]
        if len(numbers) not in _COUNTS:
            what = f"intrinsics have {len(numbers)} numbers, not 4, 8, 9 or 12"
            raise UserError(what, where, remedy)
        if not np.isfinite(numbers).all() or (numbers[:2] <= 0).any() or not np.isfinite(skew):
            raise UserError("intrinsics are not finite or not positive", where, remedy)
        return _of(numbers.tolist(), skew)


def named_camera(name: str) -> Intrinsics | None:
    """The camera that a name holds, such as that of a folder of TUM RGB-D.

    Example:
        >>> named_camera("rgbd_dataset_freiburg3_cabinet").K[0, 0]
        np.float64(535.4)
    """
    found = re.search(r"(?<![a-z0-9])(?:freiburg|fr)_?([123])(?![0-9])", name.lower())
    return None if found is None else _of(KNOWN_CAMERAS[f"freiburg{found[1]}"])


def _of(numbers: tuple[float, ...] | list[float], skew: float = 0.0) -> Intrinsics:
    fx, fy, cx, cy, *bends = numbers
    K = np.array([[fx, skew, cx], [0, fy, cy], [0, 0, 1.0]])
    K.setflags(write=False)
    if not any(bends):
        return Intrinsics(K, None)
    if len(bends) == 4:
        return Intrinsics(K, Lens("OPENCV", tuple(bends)))
    return Intrinsics(K, Lens("FULL_OPENCV", (*bends, *(0.0,) * (8 - len(bends)))))


def _is_matrix(numbers: FloatArray) -> bool:
    # In a list of nine, the fourth is the principal point's height, which no camera has at 0.
    return len(numbers) == 9 and numbers[3] == 0 and numbers[6:].tolist() == [0, 0, 1]
