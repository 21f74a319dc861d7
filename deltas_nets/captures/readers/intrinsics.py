"""Camera matrices in text files, and whether they can be of the images beside them."""

from pathlib import Path

import numpy as np

from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.images import in_words
from deltas_nets.captures.text_lines import read_numbers
from deltas_nets.errors import UserError

__all__ = ["doubtful_centre", "read_intrinsics"]

SPREAD = (0.35, 0.65)
"""Where a principal point lies, in parts of the image. Cameras are within 0.45 to 0.55; wider,
because a refusal stops everything. Images resized by 0.76 or 1.43 are found."""
CENTRAL = 0.08
"""How far from the middle it lies at most, if nobody cropped; a turned 4:3 image puts it 0.12 off
on both axes, others more."""
DOUBTFUL = 0.25
"""From there on it is worth a warning."""


def read_intrinsics(path: Path, image_size: tuple[int, int] | None) -> FloatArray:
    """The camera matrix of a 3x3 or 4x4 text file.

    Args:
        path: the file.
        image_size: (height, width) of the images that it is for; None if that is not known.

    Returns:
        ``(3, 3)`` float64, read-only.

    Raises:
        UserError: the file is missing, holds no camera matrix, or one of other images.
    """
    remedy = "write the 4x4 or 3x3 matrix fx 0 cx, 0 fy cy, 0 0 1 in pixels"
    if not path.is_file():
        raise UserError("the intrinsics are missing", path, remedy)
    numbers = read_numbers(path, name="intrinsics", remedy=remedy)
    if len(numbers) not in (9, 16):
        what = f"the intrinsics have {len(numbers)} numbers, neither 16 (4x4) nor 9 (3x3)"
        raise UserError(what, path, remedy)
    side = 4 if len(numbers) == 16 else 3
    matrix = np.array(numbers, dtype=np.float64).reshape(side, side)
    if not np.isfinite(matrix).all():
        raise UserError("the intrinsics hold numbers that are not finite", path, remedy)
    K = matrix[:3, :3].copy()
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        what = f"the focal lengths are not positive ({K[0, 0]:g} and {K[1, 1]:g})"
        raise UserError(what, path, remedy)
    bottom_is_standard = np.allclose(matrix[-1], np.eye(side)[-1], rtol=0, atol=1e-6)
    if not bottom_is_standard or not np.allclose(K[2], (0, 0, 1), rtol=0, atol=1e-6) or K[1, 0]:
        raise UserError("the intrinsics are not a camera matrix", path, remedy)
    if np.any(matrix[:3, 3:] != 0):
        raise UserError("the intrinsics have a fourth column that is not 0", path, remedy)
    if image_size is not None:
        _check_turned(K, image_size, path)
        _check_resolution(K, image_size, path)
    K.setflags(write=False)
    return K


def doubtful_centre(K: FloatArray, image_size: tuple[int, int], path: Path) -> str | None:
    """A warning where the principal point is far from the middle, as only that of a crop is."""
    if max(map(abs, _from_middle(K, image_size))) <= DOUBTFUL:
        return None
    return (
        f"the principal point ({K[0, 2]:g}, {K[1, 2]:g}) is far from the middle of images of "
        f"{in_words(image_size)}, {path}: check that these intrinsics are theirs"
    )


def _from_middle(K: FloatArray, image_size: tuple[int, int]) -> tuple[float, float]:
    """The principal point from the middle, right and down, in parts of the image."""
    height, width = image_size
    return float((K[0, 2] + 0.5) / width - 0.5), float((K[1, 2] + 0.5) / height - 0.5)


def _check_turned(K: FloatArray, image_size: tuple[int, int], path: Path) -> None:
    """Refuse images that are turned by 90 degrees, as phones store portraits.

    Their principal point fits height and width swapped.
    """
    right, down = _from_middle(K, image_size)
    swapped = image_size[1], image_size[0]
    off_both_ways = right * down < 0 and min(abs(right), abs(down)) > CENTRAL
    if off_both_ways and max(map(abs, _from_middle(K, swapped))) < CENTRAL:
        what = (
            f"images of {in_words(image_size)} are rotated by 90 degrees: the principal point "
            f"({K[0, 2]:g}, {K[1, 2]:g}) is of {in_words(swapped)}"
        )
        raise UserError(what, path, "rotate the images back, or write intrinsics and poses of them")


def _check_resolution(K: FloatArray, image_size: tuple[int, int], path: Path) -> None:
    """The principal point is all a file tells about the resolution it was made for.

    Outside the image it cannot belong to it. Inside, but away from the middle by the same part
    on both axes, it fits an image larger or smaller by one factor; a lens shifted like that is
    not to be expected, while intrinsics of the full resolution beside small images are.
    """
    across, down = (part + 0.5 for part in _from_middle(K, image_size))
    outside = not (0 <= across <= 1 and 0 <= down <= 1)
    low, high = SPREAD
    scaled = not low < across < high and not low < down < high and 0.9 < across / down < 1.1
    if outside or scaled:
        what = (
            f"the principal point ({K[0, 2]:g}, {K[1, 2]:g}) does not fit images of "
            f"{in_words(image_size)}: these intrinsics are of another resolution"
        )
        remedy = "scale fx, fy, cx and cy to the images' size; of a crop, state them: --intrinsics"
        raise UserError(what, path, remedy)
