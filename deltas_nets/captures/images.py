"""Image files: whether they are whole, and their pixels, decoded once where memory allows."""

import os
from collections import OrderedDict
from collections.abc import Callable, Hashable
from io import BytesIO
from pathlib import Path
from threading import Lock
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image

from deltas_nets.errors import UserError

__all__ = [
    "RAW_SUFFIXES",
    "Header",
    "ImageMemory",
    "Span",
    "decode",
    "header_of",
    "header_of_whole_file",
    "image_size_of",
    "in_words",
    "is_8_bit",
    "mode_of",
    "open_span",
    "orientation_of",
    "resize_image",
    "why_not_decoded",
]

_END_OF_JPEG = b"\xff\xd9"
_UNREADABLE = (OSError, SyntaxError, ValueError, Image.DecompressionBombError)
"""What Pillow raises where a file is no image, or a damaged one."""
RAW_SUFFIXES = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2")
"""Of what a camera's sensor saw, undeveloped."""
_NOT_PILLOWS = (".heic", ".heif", ".avif", ".jp2", *RAW_SUFFIXES)
"""Kinds of images that it does not read, or not everywhere."""


class Span(NamedTuple):
    """Some bytes of a file that holds more than one image."""

    start: int
    length: int


class Header(NamedTuple):
    """What an image file says of itself before its pixels.

    Attributes:
        size: (height, width).
        mode: Pillow's word for the type of the pixels.
    """

    size: tuple[int, int]
    mode: str


_REMEMBERING = Lock()
"""Of all memories, which threads share; not a part of them, as they are copied with captures."""


class ImageMemory:
    """Decoded images, those used last.

    Args:
        capacity: bytes that they may take.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self._known: OrderedDict[Hashable, NDArray[np.uint8]] = OrderedDict()
        self._used = 0

    def get(self, name: Hashable, read: Callable[[], NDArray[np.uint8]]) -> NDArray[np.uint8]:
        """The pixels of a name, from ``read`` if they are not known."""
        with _REMEMBERING:
            pixels = self._known.get(name)
        if pixels is None:
            pixels = read()
        with _REMEMBERING:
            if name not in self._known:  # another thread may have been faster
                self._known[name] = pixels
                self._used += pixels.nbytes
            self._known.move_to_end(name)
            while self._used > self.capacity:
                _, forgotten = self._known.popitem(last=False)
                self._used -= forgotten.nbytes
        return pixels


def open_span(path: Path, span: Span | None = None) -> BinaryIO:
    """A file, or those bytes of it."""
    if span is None:
        return path.open("rb")
    with path.open("rb") as file:
        file.seek(span.start)
        return BytesIO(file.read(span.length))


def decode(
    path: Path, span: Span | None = None, *, remedy: str, name: str = "image"
) -> Image.Image:
    """Decode every pixel, so that a file cut short is found here and not later.

    Args:
        path: the file.
        span: which bytes of it; all if None.
        remedy: what to do where it cannot be decoded.
        name: what it is called then.

    Raises:
        UserError: the file is missing, or no image, or a damaged one.
    """
    try:
        with Image.open(path if span is None else open_span(path, span)) as image:
            image.load()
            return image
    except FileNotFoundError as error:
        raise UserError(f"the {name} does not exist", path, remedy) from error
    except _UNREADABLE as error:
        what = f"the {name} cannot be decoded ({why_not_decoded(path, error)})"
        raise UserError(what, path, remedy) from error


def why_not_decoded(path: Path, error: Exception) -> str:
    """What Pillow's error means; its own texts repeat the path and a stream's address.

    Example:
        >>> why_not_decoded(Path("IMG_1.HEIC"), OSError())
        'Pillow alone reads no .heic: convert it to JPEG or PNG'
    """
    if path.is_file() and not path.stat().st_size:
        return "the file is empty"
    if "truncated" in str(error) or "unrecognized data stream" in str(error):
        return "the file is truncated"
    if isinstance(error, Image.DecompressionBombError):
        return f"it has more than {2 * (Image.MAX_IMAGE_PIXELS or 0)} pixels"
    suffix = path.suffix.lower()
    if suffix in _NOT_PILLOWS:
        return f"Pillow alone reads no {suffix}: convert it to JPEG or PNG"
    return "it is damaged, or of a kind that Pillow does not read"


def is_8_bit(header: "Header") -> bool:
    """Whether pixels are what cameras write; Pillow would clip others to white without a word."""
    return not header.mode.startswith(("I", "F"))


def header_of(image: Image.Image) -> Header:
    """What Pillow read of an image."""
    return Header((image.height, image.width), image.mode)


def header_of_whole_file(path: Path, span: Span | None = None) -> Header | None:
    """The header of a file that is surely whole; None where only decoding it can tell.

    A PNG is whole if the checksums of its chunks are right, a JPEG if it ends with the marker of
    its end, which compressed data never holds. Either takes a tenth of the time of decoding, if
    that.
    """
    try:
        with open_span(path, span) as file, Image.open(file) as image:
            header = header_of(image)
            if image.format == "PNG":
                image.verify()
                return header
            if image.format in ("JPEG", "MPO"):
                file.seek(-len(_END_OF_JPEG), os.SEEK_END)
                return header if file.read() == _END_OF_JPEG else None
    except _UNREADABLE:
        pass
    return None


def image_size_of(path: Path) -> tuple[int, int] | None:
    """(height, width) from the header of an image file; None if it is no image."""
    try:
        with Image.open(path) as image:
            return image.height, image.width
    except _UNREADABLE:
        return None


def mode_of(path: Path) -> str | None:
    """Pillow's word for the pixels of an image file, from its header; None if it is no image."""
    try:
        with Image.open(path) as image:
            return image.mode
    except _UNREADABLE:
        return None


def orientation_of(path: Path, span: Span | None = None) -> int:
    """How EXIF says that a file is to be turned, which nothing here follows; 1 is upright."""
    try:
        with Image.open(path if span is None else open_span(path, span)) as image:
            return int(image.getexif().get(ExifTags.Base.Orientation, 1))
    except (*_UNREADABLE, ValueError, TypeError):
        return 1


def in_words(size: tuple[int, int]) -> str:
    """A size (height, width) as people write it.

    Example:
        >>> in_words((480, 640))
        '640x480'
    """
    return f"{size[1]}x{size[0]}"


def resize_image(image: NDArray[np.uint8], new_size: tuple[int, int]) -> NDArray[np.uint8]:
    """Resize ``(H, W, 3)`` with antialiasing; the image keeps spanning the same field of view.

    Lanczos, because its weights follow the fractional position of each new pixel. Pillow's
    BOX takes or leaves whole pixels, so at 540 -> 320 content jumps by up to half a pixel,
    which the network would take for parallax.
    """
    height, width = new_size
    if image.shape[:2] == (height, width):
        return image.copy()  # writable, and not a view of a decoder's buffer
    resized = Image.fromarray(image).resize((width, height), Image.Resampling.LANCZOS)
    return np.array(resized)
