"""The contact sheet: images beside their depth, many at a glance."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from deltas_nets.page.colours import Scale, with_bar
from deltas_nets.page.pictures import FramePictures

__all__ = ["MOST_CELLS", "Cell", "cell_of", "contact_sheet"]

MOST_CELLS = 48
ACROSS = 4
"""Cells in a row."""
WIDE, GAP, LETTERS = 200, 8, 13
"""Pixels: of a picture, between pictures, of an id."""


class Cell(NamedTuple):
    """A frame in little.

    Attributes:
        id: of the frame.
        pair: ``(h, w, 3)`` image and depth side by side.
    """

    id: str
    pair: NDArray[np.uint8]


def cell_of(frame: FramePictures) -> Cell:
    """A frame in little."""
    height, width = frame.pictures["image"].shape[:2]
    size = (WIDE, max(1, round(WIDE * height / width)))
    small = [
        np.asarray(Image.fromarray(frame.pictures[kind]).resize(size, how))
        for kind, how in (("image", Image.Resampling.LANCZOS), ("depth", Image.Resampling.NEAREST))
    ]
    return Cell(frame.id, np.concatenate(small, axis=1))


def contact_sheet(cells: Sequence[Cell], scale: Scale) -> Image.Image:
    """All cells in rows, with their ids, above the bar of the depth's colours."""
    across = min(ACROSS, len(cells))
    tall = max(cell.pair.shape[0] for cell in cells) + LETTERS + GAP
    wide, rows = 2 * WIDE + GAP, -(-len(cells) // across)
    sheet = Image.new("RGB", (across * wide + GAP, rows * tall + GAP), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(LETTERS)
    for place, cell in enumerate(cells):
        x, y = GAP + place % across * wide, GAP + place // across * tall
        sheet.paste(Image.fromarray(cell.pair), (x, y))
        # Letters that the font has not, and ids that are too long, would draw over others.
        name = cell.id if len(cell.id) < 50 else f"...{cell.id[-46:]}"
        draw.text((x, y + cell.pair.shape[0]), name, "black", font)
    return with_bar(np.asarray(sheet), scale)
