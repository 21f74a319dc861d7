"""A frame: one image, the camera that took it, and the depth a sensor measured there."""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from deltas_nets.captures.images import Header, ImageMemory, decode, header_of_whole_file
from deltas_nets.errors import UserError

__all__ = ["FloatArray", "Frame", "Lens"]

FloatArray = NDArray[np.float64]

UNKNOWN_DEPTH = 65535
"""7-Scenes and some headsets write this for "no depth", beside 0."""

_COPY_AGAIN = "copy the file again, or remove it (and the frame from view sets)"


class Lens(NamedTuple):
    """How a camera bends straight lines.

    Attributes:
        model: as COLMAP calls it, such as SIMPLE_RADIAL.
        coefficients: of that model, without focal lengths and principal point.
    """

    model: str
    coefficients: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Frame:
    """One image, the camera that took it, and the depth a sensor measured, if any."""

    id: str
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
    lens: Lens | None = None
    """None where straight lines are straight; images with another lens are refused."""
    memory: ImageMemory | None = None
    """Where decoded images are kept, if anywhere."""

    def read_image(self) -> NDArray[np.uint8]:
        """Decode the whole image, or take it from the memory.

        Returns:
            ``(H, W, 3)`` RGB of ``image_size``, not to be written to.

        Raises:
            UserError: the file is missing, damaged, truncated, not 8-bit, or of another size, or
                its lens bends straight lines.
        """
        if self.memory is None:
            return self._decode_image()
        return self.memory.get(self.image_path, self._decode_image)

    def check_image(self) -> None:
        """Raise what :meth:`read_image` would; decode only where the file's header cannot tell.

        Raises:
            UserError: as :meth:`read_image`.
        """
        header = header_of_whole_file(self.image_path)
        if header is None:
            self.read_image()
        else:
            self._check_image(header)

    def read_depth(self) -> NDArray[np.float32]:
        """Decode the sensor depth.

        Returns:
            ``(H, W)`` metres at the depth image's own size, 0 where unknown.

        Raises:
            UserError: the frame has none, or the file is damaged, not a 16-bit image, or of another
                size.
        """
        image = decode(self._depth_path(), remedy="copy the file again")
        self._check_depth(_header(image))
        millimetres = np.asarray(image).astype(np.int64)
        unknown = (millimetres <= 0) | (millimetres >= UNKNOWN_DEPTH)
        return np.where(unknown, 0.0, millimetres / 1000.0).astype(np.float32)

    def check_depth(self) -> None:
        """Raise what :meth:`read_depth` would, as :meth:`check_image` does.

        Raises:
            UserError: as :meth:`read_depth`.
        """
        header = header_of_whole_file(self._depth_path())
        if header is None:
            self.read_depth()
        else:
            self._check_depth(header)

    def _decode_image(self) -> NDArray[np.uint8]:
        image = decode(self.image_path, remedy=_COPY_AGAIN)
        self._check_image(_header(image))
        pixels = np.asarray(image.convert("RGB"))
        pixels.setflags(write=False)
        return pixels

    def _check_image(self, header: Header) -> None:
        if self.lens is not None:
            numbers = " ".join(f"{number:g}" for number in self.lens.coefficients)
            what = f"the image is of a lens that bends lines ({self.lens.model} {numbers})"
            raise UserError(what, self.image_path, "undistort images and intrinsics first")
        if header.mode.startswith(("I", "F")):
            # Pillow would clip these to white without a word.
            what = f"image has pixels of type {header.mode}, not 8-bit colour"
            raise UserError(what, self.image_path, "convert it to an 8-bit JPEG or PNG")
        if header.size != self.image_size:
            what = f"image is {_words(header.size)}, the intrinsics are for "
            what += _words(self.image_size)
            raise UserError(what, self.image_path, "export all images of a capture at one size")

    def _depth_path(self) -> Path:
        if self.depth_path is None:
            file = self.image_path.parent.parent / "depth" / f"{self.id}.png"
            raise UserError(f"frame {self.id} has no sensor depth", file, "add the file")
        return self.depth_path

    def _check_depth(self, header: Header) -> None:
        path = self._depth_path()
        if not header.mode.startswith("I"):
            what = f"depth has pixels of type {header.mode}, not 16-bit millimetres"
            raise UserError(what, path, "export depth as a 16-bit grey PNG")
        if self.depth_size not in (None, header.size):
            of = "the others are" if self.depth_K is None else "the intrinsics are for"
            what = f"depth is {_words(header.size)}, {of} {_words(self.depth_size)}"
            raise UserError(what, path, "export all depth of a capture at one size")


def _header(image: Image.Image) -> Header:
    return Header((image.height, image.width), image.mode)


def _words(size: tuple[int, int]) -> str:
    return f"{size[1]}x{size[0]}"
