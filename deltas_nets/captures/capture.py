"""A capture: posed frames of one scene, whatever the folder they came from looks like."""

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from deltas_nets.errors import UserError

__all__ = ["Capture", "FloatArray", "Frame", "ids_in_words", "image_size_of"]

FloatArray = NDArray[np.float64]

UNKNOWN_DEPTH = 65535
"""7-Scenes and some headsets write this for "no depth", beside 0."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One image, the camera that took it, and the depth a sensor measured, if any."""

    id: int | str
    image_path: Path
    image_size: tuple[int, int]
    """(height, width) of the image file."""
    K: FloatArray
    """(3, 3) intrinsics for the image at its own size, pixel centres at integers."""
    cam_from_world: FloatArray
    """(4, 4) rigid, OpenCV axes, metres."""
    depth_path: Path | None = None
    depth_K: FloatArray | None = None
    """(3, 3) intrinsics of the depth image; None where it sees what the colour image sees."""
    depth_size: tuple[int, int] | None = None
    """(height, width) of the depth image; None where any will do."""

    def read_image(self) -> NDArray[np.uint8]:
        """Decode the whole image.

        Returns:
            ``(H, W, 3)`` RGB of ``image_size``.

        Raises:
            UserError: the file is missing, damaged, truncated, not 8-bit, or of another size.
        """
        remedy = "copy the file again, or remove it (and the frame from view sets)"
        image = _decode(self.image_path, remedy=remedy)
        if image.mode.startswith(("I", "F")):
            # Pillow would clip these to white without a word.
            what = f"image has pixels of type {image.mode}, not 8-bit colour"
            raise UserError(what, self.image_path, "convert it to an 8-bit JPEG or PNG")
        if (image.height, image.width) != self.image_size:
            height, width = self.image_size
            what = f"image is {image.width}x{image.height}, the intrinsics are for {width}x{height}"
            raise UserError(what, self.image_path, "export all images of a capture at one size")
        return np.asarray(image.convert("RGB"))

    def read_depth(self) -> NDArray[np.float32]:
        """Decode the sensor depth.

        Returns:
            ``(H, W)`` metres at the depth image's own size, 0 where unknown.

        Raises:
            UserError: the frame has none, or the file is damaged, not a 16-bit image, or of another
                size.
        """
        if self.depth_path is None:
            file = self.image_path.parent.parent / "depth" / f"{self.id}.png"
            raise UserError(f"frame {self.id} has no sensor depth", file, "add the file")
        image = _decode(self.depth_path, remedy="copy the file again")
        if not image.mode.startswith("I"):
            what = f"depth has pixels of type {image.mode}, not 16-bit millimetres"
            raise UserError(what, self.depth_path, "export depth as a 16-bit grey PNG")
        if self.depth_size not in (None, (image.height, image.width)):
            height, width = self.depth_size
            of = "the others are" if self.depth_K is None else "the intrinsics are for"
            what = f"depth is {image.width}x{image.height}, {of} {width}x{height}"
            raise UserError(what, self.depth_path, "export all depth of a capture at one size")
        millimetres = np.asarray(image).astype(np.int64)
        unknown = (millimetres <= 0) | (millimetres >= UNKNOWN_DEPTH)
        return np.where(unknown, 0.0, millimetres / 1000.0).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Capture:
    """The frames of one folder."""

    path: Path
    """The folder that holds the images' folder: the scene, where captures are nested."""
    frames: Mapping[int, Frame]
    """Frames with a usable pose, in the order of their ids."""
    lost: Mapping[int, UserError]
    """Frames left out because of their pose, with the error that asking for them raises."""
    doubts: tuple[str, ...] = ()
    """What may be a mistake, each for a warning."""

    def fingerprint(self) -> str:
        """A hash of all cameras: what changes when poses or intrinsics do."""
        digest = hashlib.sha256()
        for id, frame in self.frames.items():
            digest.update(f"{id} {frame.image_size}".encode())
            digest.update(frame.K.tobytes() + frame.cam_from_world.tobytes())
        return digest.hexdigest()

    def frame(self, id: int) -> Frame:
        """The frame called ``id``.

        Raises:
            UserError: there is none (names the nearest ids), or its pose was lost.
        """
        if id in self.frames:
            return self.frames[id]
        if id in self.lost:
            raise self.lost[id]
        nearest = sorted(sorted(self.frames, key=lambda other: (abs(other - id), other))[:4])
        remedy = f"use a frame it has; the nearest are {ids_in_words(nearest)}"
        raise UserError(f"the capture has no frame {id}", self.path, remedy)


def image_size_of(path: Path) -> tuple[int, int] | None:
    """(height, width) from the header of an image file; None if it is no image."""
    try:
        with Image.open(path) as image:
            return image.height, image.width
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError):
        return None


def ids_in_words(ids: Iterable[int | str], limit: int = 5) -> str:
    """A few ids for an error message.

    Example:
        >>> ids_in_words(range(9), limit=3)
        '0, 1, 2 and 6 more'
    """
    names = [str(id) for id in ids]
    more = f" and {len(names) - limit} more" if len(names) > limit else ""
    return ", ".join(names[:limit]) + more


def _decode(path: Path, *, remedy: str) -> Image.Image:
    """Decode every pixel, so that a file cut short is found here and not later."""
    try:
        with Image.open(path) as image:
            image.load()
            return image
    except FileNotFoundError as error:
        raise UserError("the image does not exist", path, remedy) from error
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        # Pillow's own texts repeat the path and a stream's address; only some help.
        detail = " (the file is truncated)" if "truncated" in str(error) else ""
        raise UserError(f"the image cannot be decoded{detail}", path, remedy) from error
