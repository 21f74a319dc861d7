"""Confidence maps of a folder, read again."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from deltas_nets.errors import UserError
from deltas_nets.outputs.depth_formats import MAKE_ANEW

__all__ = ["confidence_file", "read_confidence"]


def confidence_file(folder: Path, id: str) -> Path:
    """Where the confidence of a frame's map lies."""
    return folder / "confidence" / f"{id}.png"


def read_confidence(folder: Path, id: str) -> NDArray[np.uint8]:
    """``(H, W)`` of a frame's map, 0 to 255 for 0 to 1.

    Raises:
        UserError: there is none, or it cannot be read.
    """
    file = confidence_file(folder, id)
    try:
        with Image.open(file) as image:
            return np.array(image.convert("L"))
    except (OSError, SyntaxError, ValueError) as error:
        what = f"the confidence map cannot be read ({error})"
        raise UserError(what, file, MAKE_ANEW) from error
