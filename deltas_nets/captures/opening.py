"""From a folder to a capture, whatever its layout."""

from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from deltas_nets.captures.capture import Capture
from deltas_nets.errors import UserError


def open_capture(path: str | Path) -> Capture:
    """Read poses, intrinsics and sizes of a capture; no pixels are decoded.

    Args:
        path: a folder in ScanNet's export layout, or a folder with one such scene inside.

    Returns:
        A capture with at least one frame.

    Raises:
        UserError: the folder or a file in it is missing or malformed; the text names it.
    """
    # Here, because readers build frames and therefore import this file.
    from deltas_nets.captures.readers import scannet

    # A further format is a file in readers/ and a line here.
    readers: tuple[tuple[Callable[[Path], bool], Callable[[Path], Capture]], ...] = (
        (scannet.recognises, scannet.read),
    )

    path = Path(path)
    if not path.exists():
        raise UserError("the capture does not exist", path, "check the path")
    if not path.is_dir():
        raise UserError("the capture is not a folder", path, "name the folder that holds color/")
    try:
        for recognises, read in readers:
            if recognises(path):
                return read(path)
        _explain_unknown(path)
    except OSError as error:
        what = f"the capture cannot be read ({error.strerror or error})"
        raise UserError(what, Path(error.filename or path), "check its permissions") from error


def _explain_unknown(path: Path) -> NoReturn:
    """Say what a capture should look like to someone whose folder has no layout we know."""
    remedy = "a capture has folders color, pose and intrinsic (ScanNet's export layout)"
    raise UserError("there is no folder color with images, as every capture has", path, remedy)
