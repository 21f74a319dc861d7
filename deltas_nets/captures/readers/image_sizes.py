"""Cameras of images that may be of another size than the capture says."""

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from deltas_nets.captures.frame import FloatArray, Lens
from deltas_nets.captures.images import image_size_of, in_words, orientation_of
from deltas_nets.errors import UserError

__all__ = ["SizedCamera", "at_size", "doubts_of_sizes", "first_size", "size_of_first"]

EXIF_TURNED = "turn the files as their EXIF says, or estimate the poses of the files as they are"
TURNED = "rotate the images back, or write size, intrinsics and poses of the images as they are"
OF_ANOTHER_SHAPE = "use the images that the poses were estimated of"
ON_A_SIDE = range(5, 9)
"""What EXIF says of files that are to be turned by 90 degrees."""


class SizedCamera(NamedTuple):
    """A camera at the size of its image files.

    Attributes:
        image_size: (height, width).
        K: ``(3, 3)`` at that size.
        lens: None where straight lines are straight.
        scale: ``(2,)`` right and down, from the camera as stated.
        stated: (height, width) that the capture says.
        image: the file that was compared.
    """

    image_size: tuple[int, int]
    K: FloatArray
    lens: Lens | None
    scale: FloatArray
    stated: tuple[int, int]
    image: Path


def first_size(images: Iterable[Path]) -> tuple[Path, tuple[int, int]] | None:
    """The first image that can be read, and its (height, width).

    It stands for all of its camera: each image is compared when it is read.
    """
    sizes = ((image, image_size_of(image)) for image in images)
    return next(((image, size) for image, size in sizes if size is not None), None)


def size_of_first(images: Iterable[Path]) -> tuple[int, int] | None:
    """Size of the first readable image, where one intrinsic file serves all: they have one size.

    Only one header is read: 2000 would take seconds on a network drive. A damaged first file is no
    obstacle while nobody needs it.
    """
    found = first_size(images)
    return None if found is None else found[1]


def at_size(
    K: FloatArray,
    lens: Lens | None,
    *,
    stated: tuple[int, int],
    size: tuple[int, int],
    image: Path,
) -> SizedCamera:
    """A camera for images of a size, which shows the same as the stated one.

    Args:
        K: ``(3, 3)`` at the stated size.
        lens: does not change with the size.
        stated: (height, width) of the capture.
        size: (height, width) of the file.
        image: the file, for errors.

    Raises:
        UserError: one is no resized version of the other.

    Example:
        >>> K = np.array([[500.0, 0, 319.5], [0, 500, 239.5], [0, 0, 1]])
        >>> at_size(K, None, stated=(480, 640), size=(240, 320), image=Path("0.png")).K[0].tolist()
        [250.0, 0.0, 159.5]
    """
    (height, width), (rows, columns) = stated, size
    scale = np.array([columns / width, rows / height])
    one = np.sqrt(scale[0] * scale[1])
    # A resized image is rounded to whole pixels on each axis.
    if abs(columns - one * width) > 1 or abs(rows - one * height) > 1:
        what = f"the image is {in_words(size)}, its camera is for {in_words(stated)}"
        turned = abs(columns * height - rows * width) > abs(columns * width - rows * height)
        exif = turned and orientation_of(image) in ON_A_SIDE
        raise UserError(
            what, image, EXIF_TURNED if exif else TURNED if turned else OF_ANOTHER_SHAPE
        )
    scaled = K.copy()
    scaled[:2] *= scale[:, None]
    scaled[:2, 2] += (scale - 1) / 2
    scaled.setflags(write=False)
    return SizedCamera(size, scaled, lens, scale, stated, image)


def doubts_of_sizes(cameras: Iterable[SizedCamera]) -> list[str]:
    """What is to be said where intrinsics were scaled."""
    other = [camera for camera in cameras if camera.image_size != camera.stated]
    if not other:
        return []
    first, more = other[0], f", as are {len(other) - 1} more" if len(other) > 1 else ""
    said = f"the image is {in_words(first.image_size)}, its camera is for {in_words(first.stated)}"
    return [f"{said}, {first.image}: its intrinsics are scaled{more}"]
