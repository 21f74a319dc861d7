"""A frame: one image, the camera that took it, and the depth a sensor measured there."""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deltas_nets.captures.depth_files import MILLIMETRES, StoredDepth, depth_format
from deltas_nets.captures.images import (
    Header,
    ImageMemory,
    Span,
    decode,
    header_of,
    header_of_whole_file,
    in_words,
    is_8_bit,
    orientation_of,
    resize_image,
)
from deltas_nets.errors import UserError

__all__ = ["FloatArray", "Frame", "Lens"]

FloatArray = NDArray[np.float64]

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
    cam_from_depth: FloatArray | None = None
    """(4, 4) where the depth camera stands; None where depth is registered: as the colour camera.
    `deltas_nets.captures.register.register_depth` moves depth to the colour image."""
    depth_scale: float = MILLIMETRES
    """Steps of the depth image in a metre, where it holds whole numbers."""
    depth_unit: float = 1.0
    """Metres in a unit of the depth image, where it holds floats."""
    lens: Lens | None = None
    """None where straight lines are straight."""
    image_span: Span | None = None
    """Which bytes of ``image_path`` are the image; None for the whole file."""
    depth_span: Span | None = None
    """Which bytes of ``depth_path`` are the depth."""
    memory: ImageMemory | None = None
    """Where decoded images are kept, if anywhere."""

    @property
    def extent(self) -> float:
        """Times the usual pixels that the network should see of it."""
        return 1.0

    def read_image(self) -> NDArray[np.uint8]:
        """Decode the whole image, or take it from the memory.

        Returns:
            ``(H, W, 3)`` RGB of ``image_size``, not to be written to; the lens is not undone.

        Raises:
            UserError: the file is missing, damaged, truncated, not 8-bit, or of another size.
        """
        if self.memory is None:
            return self._decode_image()
        return self.memory.get((self.image_path, self.image_span), self._decode_image)

    def read_resized(self, size: tuple[int, int]) -> NDArray[np.uint8]:
        """The image ``(h, w, 3)`` at another size; see :func:`resize_image`."""
        return resize_image(self.read_image(), size)

    def check_image(self) -> None:
        """Raise what :meth:`read_image` would; decode only where the file's header cannot tell.

        Raises:
            UserError: as :meth:`read_image`.
        """
        header = header_of_whole_file(self.image_path, self.image_span)
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
        path = self._depth_path()
        depth = depth_format(path).read(self._stored_depth(path))
        self._check_depth_size((depth.shape[0], depth.shape[1]))
        return depth

    def check_depth(self) -> None:
        """Raise what :meth:`read_depth` would, as :meth:`check_image` does.

        Raises:
            UserError: as :meth:`read_depth`.
        """
        path = self._depth_path()
        size = depth_format(path).size_of_whole_file(self._stored_depth(path))
        if size is None:
            self.read_depth()
        else:
            self._check_depth_size(size)

    def _decode_image(self) -> NDArray[np.uint8]:
        image = decode(self.image_path, self.image_span, remedy=_COPY_AGAIN)
        self._check_image(header_of(image))
        # Of what is RGB already convert would make a copy.
        pixels = np.asarray(image if image.mode == "RGB" else image.convert("RGB"))
        pixels.setflags(write=False)
        return pixels

    def _check_image(self, header: Header) -> None:
        if not is_8_bit(header):
            what = f"image has pixels of type {header.mode}, not 8-bit colour"
            raise UserError(what, self.image_path, "convert it to an 8-bit JPEG or PNG")
        if header.size != self.image_size:
            what = f"image is {in_words(header.size)}, the intrinsics are for "
            what += in_words(self.image_size)
            remedy = "export all images of a capture at one size"
            if orientation_of(self.image_path, self.image_span) != 1:
                what += "; its EXIF says that it is to be turned, which is not followed"
                remedy = "turn the file as its EXIF says, or leave it out"
            elif header.size == self.image_size[::-1]:
                what += ": it is rotated by 90 degrees"
                remedy = "rotate it back, or leave it out"
            raise UserError(what, self.image_path, remedy)

    def _depth_path(self) -> Path:
        if self.depth_path is None:
            file = self.image_path.parent.parent / "depth" / f"{self.id}.png"
            raise UserError(f"frame {self.id} has no sensor depth", file, "add the file")
        return self.depth_path

    def _stored_depth(self, path: Path) -> StoredDepth:
        size, unit = self.depth_size, self.depth_unit
        return StoredDepth(path, self.depth_span, self.depth_scale, size, unit)

    def _check_depth_size(self, size: tuple[int, int]) -> None:
        if self.depth_size not in (None, size):
            of = "the others are" if self.depth_K is None else "the intrinsics are for"
            what = f"depth is {in_words(size)}, {of} {in_words(self.depth_size)}"
            raise UserError(what, self._depth_path(), "export all depth of a capture at one size")
