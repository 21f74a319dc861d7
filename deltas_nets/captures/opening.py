"""From a folder to a capture, whatever its layout."""

from pathlib import Path
from typing import Protocol

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.ids import ids_in_words
from deltas_nets.captures.readers import scannet
from deltas_nets.errors import UserError

__all__ = ["READERS", "Reader", "open_capture"]


class Reader(Protocol):
    """What a file in readers/ defines."""

    LAYOUT: str
    """What a capture of this format is, in a few words after "a capture is"."""

    def recognises(self, path: Path) -> bool:
        """Whether a folder looks like this format; it may be broken, which `read` explains."""

    def read(self, path: Path) -> Capture:
        """Read poses and intrinsics; no pixels are decoded.

        Frames that cannot be used are in ``lost``: training counts them, `open_capture` accepts
        those without a pose and raises the others.

        Raises:
            UserError: something that all frames need is missing or malformed; the text names it.
            OSError: the system refuses to read a file.
        """


READERS: tuple[Reader, ...] = (scannet,)
"""The first that recognises a folder reads it."""


def open_capture(path: str | Path) -> Capture:
    """Read poses, intrinsics and sizes of a capture; no pixels are decoded.

    Args:
        path: a folder in one of the layouts of `READERS`.

    Returns:
        A capture with at least one frame.

    Raises:
        UserError: the folder or a file in it is missing or malformed; the text names it.
    """
    path = Path(path)
    layouts = "a capture is " + "; or ".join(reader.LAYOUT for reader in READERS)
    if not path.exists():
        raise UserError("the capture does not exist", path, "check the path")
    if not path.is_dir():
        raise UserError("the capture is not a folder", path, layouts)
    try:
        reader = next((reader for reader in READERS if reader.recognises(path)), None)
        if reader is None:
            raise UserError("there is no capture in the folder", path, layouts)
        return _usable(reader.read(path))
    except OSError as error:
        what = f"the capture cannot be read ({error.strerror or error})"
        raise UserError(what, Path(error.filename or path), "check its permissions") from error


def _usable(capture: Capture) -> Capture:
    """The capture, unless a pose is wrong or none is there."""
    for lost in capture.lost.values():
        if lost.reason != "no pose":
            raise lost.error
    if not capture.frames:
        what = f"every pose is lost (NaN, infinite or missing; frames {ids_in_words(capture.lost)})"
        where = [Path(lost.error.where).parent for lost in capture.lost.values()]
        raise UserError(what, next(iter(where), capture.path), "run the tracking again")
    return capture
