"""Camera matrices and sizes from the numbers that formats state."""

from pathlib import Path

import numpy as np

from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.images import in_words
from deltas_nets.captures.readers.image_sizes import SizedCamera, at_size
from deltas_nets.captures.readers.json_file import Fields
from deltas_nets.errors import UserError

__all__ = ["CORNER", "camera_matrix", "camera_of_matrix", "fitted", "size_of"]

CORNER = 0.5
"""What is subtracted from principal points of programs that put the image's corner at 0."""


def camera_matrix(
    fx: float, fy: float, cx: float, cy: float, *, path: Path, skew: float = 0.0
) -> FloatArray:
    """``(3, 3)``, read-only.

    Args:
        fx: focal length in pixels, as ``fy``.
        fy: see ``fx``.
        cx: principal point, pixel centres at integers, as ``cy``.
        cy: see ``cx``.
        path: the file that states them, for errors.
        skew: what a matrix holds beside fx, pixels.

    Raises:
        UserError: they are not finite, or a focal length is not positive.
    """
    K = np.array([[fx, skew, cx], [0, fy, cy], [0, 0, 1.0]])
    if not np.isfinite(K).all() or min(fx, fy) <= 0:
        what = f"fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g} are no camera"
        raise UserError(what, path, "state focal lengths and principal point in pixels")
    K.setflags(write=False)
    return K


def camera_of_matrix(matrix: FloatArray, *, path: Path, corner: float = 0.0) -> FloatArray:
    """``(3, 3)``, read-only, of a matrix by rows that may hold more.

    Args:
        matrix: ``(3, 3)`` or ``(4, 4)``.
        path: the file that states it, for errors.
        corner: `CORNER` of a program that puts the image's corner at 0.

    Raises:
        UserError: as `camera_matrix`.
    """
    (fx, skew, cx), (_, fy, cy) = matrix[:2, :3].tolist()
    return camera_matrix(fx, fy, cx - corner, cy - corner, path=path, skew=skew)


def size_of(fields: Fields, height: str, width: str) -> tuple[int, int]:
    """(height, width) of images, as two fields state it.

    Raises:
        UserError: a number is missing, or is no number of pixels.
    """
    sides = fields.number(height), fields.number(width)
    if not all(1 <= side < 2**20 and side == int(side) for side in sides):
        what = f"has a size of {sides[1]:g} x {sides[0]:g} pixels"
        raise fields.error(what, width)
    return int(sides[0]), int(sides[1])


def fitted(
    K: FloatArray, stated: tuple[int, int], size: tuple[int, int], *, image: Path
) -> SizedCamera:
    """The camera of an image that may be of another size than the capture states.

    Args:
        K: ``(3, 3)`` of images of the stated size.
        stated: (height, width) that the intrinsics are for.
        size: (height, width) of the image.
        image: the file, for errors.

    Returns:
        A camera, whose K is ``(3, 3)`` and read-only.

    Raises:
        UserError: one is no resized version of the other: the image is turned or cropped.
    """
    if min(stated) < 1:
        what = f"the camera is said to have {in_words(stated)} pixels"
        raise UserError(what, image, "state the size that the intrinsics are for")
    return at_size(K, None, stated=stated, size=size, image=image)
