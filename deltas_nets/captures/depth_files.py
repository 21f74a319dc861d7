"""Files of sensor depth: a table of formats, each of which reads metres."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deltas_nets.captures.images import Header, Span, decode, header_of, header_of_whole_file
from deltas_nets.errors import UserError

__all__ = ["DEPTH_FORMATS", "MILLIMETRES", "DepthFormat", "depth_format"]

MILLIMETRES = 1000.0
"""Steps in a metre."""
UNKNOWN_DEPTH = 65535
"""7-Scenes and some headsets write this for "no depth", beside 0."""


class DepthFormat(NamedTuple):
    """How the depth of files with a suffix is read.

    Attributes:
        read: from a file, the bytes of it that count (None for all), and the steps in a metre to
            ``(H, W)`` metres, 0 where unknown; raises `UserError`.
        size_of_whole_file: (height, width) of a file that is surely whole, None where only
            reading it can tell; raises `UserError` for what is no depth.
    """

    read: Callable[[Path, Span | None, float], NDArray[np.float32]]
    size_of_whole_file: Callable[[Path, Span | None], tuple[int, int] | None]


def depth_format(path: Path) -> DepthFormat:
    """The format of a file, by its suffix."""
    return DEPTH_FORMATS.get(path.suffix.lower(), _STEPS)


def _read_steps(path: Path, span: Span | None, scale: float) -> NDArray[np.float32]:
    image = decode(path, span, remedy="copy the file again")
    _check_steps(header_of(image), path)
    steps = np.asarray(image).astype(np.int64)
    unknown = (steps <= 0) | (steps >= UNKNOWN_DEPTH)
    return np.where(unknown, 0.0, steps / scale).astype(np.float32)


def _size_of_steps(path: Path, span: Span | None) -> tuple[int, int] | None:
    header = header_of_whole_file(path, span)
    if header is None:
        return None
    _check_steps(header, path)
    return header.size


def _check_steps(header: Header, path: Path) -> None:
    if not header.mode.startswith("I"):
        what = f"depth has pixels of type {header.mode}, not 16-bit millimetres"
        raise UserError(what, path, "export depth as a 16-bit grey PNG")


_STEPS = DepthFormat(_read_steps, _size_of_steps)

DEPTH_FORMATS = {".png": _STEPS}
"""By suffix. What is not here is read as an image of whole numbers."""
