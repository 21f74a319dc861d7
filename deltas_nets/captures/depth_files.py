"""Files of sensor depth: a table of formats, each of which reads metres."""

import zlib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deltas_nets.captures import float_files
from deltas_nets.captures.exr import read_exr
from deltas_nets.captures.float_files import read_npy, read_pfm, unzipped
from deltas_nets.captures.images import (
    Header,
    Span,
    decode,
    header_of,
    header_of_whole_file,
    mode_of,
)
from deltas_nets.captures.images import open_span as open_span
from deltas_nets.errors import UserError

__all__ = [
    "DEPTH_FORMATS",
    "MILLIMETRES",
    "DepthFormat",
    "StoredDepth",
    "depth_format",
    "holds_floats",
]

MILLIMETRES = 1000.0
"""Steps in a metre."""
UNKNOWN_DEPTH = 65535
"""7-Scenes and some headsets write this for "no depth", beside 0."""
_ALWAYS_FLOATS, _ARRAYS, _TIFF = (".pfm", ".exr"), (".npy", ".npz"), (".tif", ".tiff")
"""Suffixes of files of floats, and of those that hold them or whole numbers."""
FILE_LIMIT = 2**30
"""Bytes of a file of floats."""


class StoredDepth(NamedTuple):
    """Where the depth of a frame is.

    Attributes:
        path: the file.
        span: which bytes of it are the depth; None for all.
        scale: steps in a metre, where whole numbers are stored.
        size: (height, width); None where the file alone says it.
        unit: metres in a unit of it, where floats are stored.
    """

    path: Path
    span: Span | None
    scale: float
    size: tuple[int, int] | None
    unit: float = 1.0


class DepthFormat(NamedTuple):
    """How the depth of files with a suffix is read.

    Attributes:
        read: to ``(H, W)`` metres, 0 where unknown; raises `UserError`.
        size_of_whole_file: (height, width) of a file that is surely whole, None where only
            reading it can tell; raises `UserError` for what is no depth.
    """

    read: Callable[[StoredDepth], NDArray[np.float32]]
    size_of_whole_file: Callable[[StoredDepth], tuple[int, int] | None]


def depth_format(path: Path) -> DepthFormat:
    """The format of a file, by its suffix."""
    return DEPTH_FORMATS.get(path.suffix.lower(), _STEPS)


def holds_floats(path: Path) -> bool:
    """Whether a file of depth holds floats, in a unit, and not whole numbers, which are steps.

    Of formats that can hold either the file is looked into; one that cannot be read holds none.
    """
    suffix = path.suffix.lower()
    if suffix in _ALWAYS_FLOATS:
        return True
    if suffix in _ARRAYS:
        return float_files.holds_floats(path)
    return suffix in _TIFF and mode_of(path) == "F"


def _metres(steps: NDArray[np.integer], scale: float) -> NDArray[np.float32]:
    unknown = (steps <= 0) | (steps == UNKNOWN_DEPTH)
    return np.where(unknown, 0.0, steps / scale).astype(np.float32)


def _in_unit(depth: NDArray[np.float32], unit: float) -> NDArray[np.float32]:
    known = np.isfinite(depth) & (depth > 0)
    return np.where(known, depth, np.float32(0)) * np.float32(unit)


def _read_image(stored: StoredDepth) -> NDArray[np.float32]:
    """Whole numbers are steps; floats, which a TIFF may hold, are in the unit."""
    remedy = "copy the file again"
    image = decode(stored.path, stored.span, remedy=remedy, name="sensor depth")
    if image.mode == "F":
        return _in_unit(np.asarray(image, dtype=np.float32), stored.unit)
    _check_steps(header_of(image), stored.path)
    return _metres(np.asarray(image), stored.scale)


def _read_array(stored: StoredDepth) -> NDArray[np.float32] | NDArray[np.integer]:
    data = _bytes(stored)
    if stored.path.suffix.lower() == ".npz":
        data = unzipped(data, stored.path, FILE_LIMIT)
    return read_npy(data, stored.path)


def _read_numbers(stored: StoredDepth) -> NDArray[np.float32]:
    """Whole numbers are steps, as in an image; floats are in the unit."""
    array = _read_array(stored)
    if array.dtype == np.float32:
        return _in_unit(array, stored.unit)  # type: ignore[arg-type]
    return _metres(array, stored.scale)  # type: ignore[arg-type]


def _size_of_steps(stored: StoredDepth) -> tuple[int, int] | None:
    header = header_of_whole_file(stored.path, stored.span)
    if header is None:
        return None
    _check_steps(header, stored.path)
    return header.size


def _check_steps(header: Header, path: Path) -> None:
    if not header.mode.startswith("I"):
        what = f"depth has pixels of type {header.mode}, not 16-bit millimetres"
        raise UserError(what, path, "export depth as a 16-bit grey PNG")


def _floats(
    read: Callable[[bytes, Path], NDArray[np.float32]],
) -> Callable[[StoredDepth], NDArray[np.float32]]:
    def read_file(stored: StoredDepth) -> NDArray[np.float32]:
        return _in_unit(read(_bytes(stored), stored.path), stored.unit)

    return read_file


def _bytes(stored: StoredDepth) -> bytes:
    try:
        length = stored.path.stat().st_size if stored.span is None else stored.span.length
        if length > FILE_LIMIT or not stored.path.is_file():
            what = f"the depth is no file of less than {FILE_LIMIT // 2**20} MiB"
            raise UserError(what, stored.path, "export depth as a 16-bit grey PNG")
        with open_span(stored.path, stored.span) as file:
            return file.read()
    except OSError as error:
        what = f"the sensor depth cannot be read ({error.strerror or error})"
        raise UserError(what, stored.path, "copy the file again") from error


def _read_packed_steps(stored: StoredDepth) -> NDArray[np.float32]:
    """16-bit whole numbers inside of a larger file, stored or deflated.

    What unpacks to more than the depth that is due is not unpacked further.
    """
    damaged = UserError(
        "depth inside of the file is damaged", stored.path, "copy or export the file again"
    )
    if stored.size is None or stored.span is None:
        raise damaged
    due = 2 * stored.size[0] * stored.size[1]
    data = _bytes(stored)
    if len(data) != due:
        try:
            data = zlib.decompressobj().decompress(data, due)
        except zlib.error as error:
            raise damaged from error
    if len(data) != due:
        raise damaged
    return _metres(np.frombuffer(data, "<u2").reshape(stored.size), stored.scale)


def _only_reading_tells(stored: StoredDepth) -> None:
    return None


_STEPS = DepthFormat(_read_image, _size_of_steps)

DEPTH_FORMATS = {
    ".png": _STEPS,
    ".exr": DepthFormat(_floats(read_exr), _only_reading_tells),
    ".pfm": DepthFormat(_floats(read_pfm), _only_reading_tells),
    ".npy": DepthFormat(_read_numbers, _only_reading_tells),
    ".npz": DepthFormat(_read_numbers, _only_reading_tells),
    ".sens": DepthFormat(_read_packed_steps, _only_reading_tells),
}
"""By suffix. What is not here is read as an image of whole numbers, or a TIFF of floats. Whole
numbers of any file are steps; floats are metres, or in the capture's unit."""
