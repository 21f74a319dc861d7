"""Camera matrices from the numbers that formats state."""

from pathlib import Path

import numpy as np

from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.images import in_words
from deltas_nets.errors import UserError

__all__ = ["CORNER", "camera_matrix", "fitted"]

CORNER = 0.5
"""What is subtracted from principal points of programs that put the image's corner at 0."""

_ASPECT = 0.02


def camera_matrix(fx: float, fy: float, cx: float, cy: float, *, path: Path) -> FloatArray:
    """``(3, 3)``, read-only.

    Args:
        fx: focal length in pixels, as ``fy``.
        fy: see ``fx``.
        cx: principal point, pixel centres at integers, as ``cy``.
        cy: see ``cx``.
        path: the file that states them, for errors.

    Raises:
        UserError: they are not finite, or a focal length is not positive.
    """
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    if not np.isfinite(K).all() or min(fx, fy) <= 0:
        what = f"fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g} are no camera"
        raise UserError(what, path, "state focal lengths and principal point in pixels")
    K.setflags(write=False)
    return K


def fitted(
    K: FloatArray, stated: tuple[int, int], actual: tuple[int, int], *, path: Path
) -> FloatArray:
    """Intrinsics of images of another size than the file states.

    Args:
        K: ``(3, 3)`` of images of the stated size.
        stated: (height, width) that the intrinsics are for.
        actual: (height, width) of the images.
        path: the file that states them.

    Returns:
        ``(3, 3)``, read-only.

    Raises:
        UserError: the images have another shape: they are turned or cropped.
    """
    if stated == actual:
        return K
    down, across = actual[0] / max(stated[0], 1e-9), actual[1] / max(stated[1], 1e-9)
    if not abs(down / across - 1) <= _ASPECT if across else True:
        what = f"the intrinsics are for {in_words(stated)}, the image is {in_words(actual)}"
        raise UserError(what, path, "undo the crop or the turn of the images")
    shift_x, shift_y = (across - 1) / 2, (down - 1) / 2
    change = np.array([[across, 0, shift_x], [0, down, shift_y], [0, 0, 1]])
    scaled: FloatArray = change @ K
    scaled.setflags(write=False)
    return scaled
