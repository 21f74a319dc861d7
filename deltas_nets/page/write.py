"""The page and what lies beside it: coloured previews of all maps, and a contact sheet."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from deltas_nets.captures.spread import spread
from deltas_nets.evaluate.scores import resize_nearest
from deltas_nets.outputs.atomic_files import remove_temporary, write_atomically
from deltas_nets.outputs.beside import PAGE, PREVIEWS, SHEET, preview_file
from deltas_nets.page.budget import MOST_BYTES, choose
from deltas_nets.page.colours import Scale, coloured, depth_scale, with_bar
from deltas_nets.page.html import ShownFrame, bytes_of_frame, bytes_of_layer, html_of, shown_frame
from deltas_nets.page.maps import Maps
from deltas_nets.page.pictures import pictures_of, sample_of_depth, size_within
from deltas_nets.page.scene import layers_of
from deltas_nets.page.sheet import MOST_CELLS, cell_of, contact_sheet
from deltas_nets.terminal import counted, warn

__all__ = ["Page", "write_page"]

PREVIEW_LONGEST, QUALITY = 1024, 90
BYTES_OF_CAMERA = 260
FRAME_OF_PAGE = 100_000
"""Bytes of all but pictures, surfaces and cameras."""


class Page(NamedTuple):
    """What was written.

    Attributes:
        path: of the page.
        maps: how many there are.
        shown: how many of them the page shows.
        size: of the page, bytes.
    """

    path: Path
    maps: int
    shown: int
    size: int

    @property
    def line(self) -> str:
        """What to tell of it."""
        some = "" if self.shown == self.maps else f", {self.shown} of {self.maps} maps"
        return f"look at {self.path} ({self.size / 1e6:.1f} MB{some})"


def write_page(
    maps: Maps,
    *,
    depth_range: tuple[float, float] = (0.5, 10.0),
    report: Callable[[str], None] = lambda _: None,
) -> Page:
    """Write index.html, contact_sheet.jpg and preview/ID.jpg beside the maps of a folder.

    The page needs no other file and no network, and stays below 15 MB.

    Args:
        maps: from `deltas_nets.page.maps.open_maps`.
        depth_range: (near, far) of the true depth that counts for errors, metres.
        report: called with the id of every finished frame.

    Raises:
        UserError: a file cannot be read or written. The page of before, if any, stays then. Of
            sensor depth that cannot be read it is a warning.
    """
    folder = maps.folder
    remove_temporary((folder / PREVIEWS).rglob("*"))
    scale = depth_scale(sample_of_depth(maps), maps.unit)
    layers = layers_of(maps)

    def shown(id: str, depth: NDArray[np.float32], longest: int) -> ShownFrame:
        return shown_frame(pictures_of(maps, id, depth, scale, depth_range, longest))

    room = MOST_BYTES - FRAME_OF_PAGE - BYTES_OF_CAMERA * len(maps.ids)
    room -= sum(map(bytes_of_layer, layers))
    chosen = choose(
        maps.ids, room, lambda id, longest: bytes_of_frame(shown(id, maps.depth(id), longest))
    )
    on_page, on_sheet = set(chosen.ids), set(spread(chosen.ids, MOST_CELLS))
    frames, cells, unread = [], [], []
    for id in maps.ids:
        depth = maps.depth(id)
        _write_preview(preview_file(folder, id), depth, scale)
        if id in on_page:
            found = pictures_of(maps, id, depth, scale, depth_range, chosen.longest)
            frames.append(shown_frame(found))
            unread += [] if found.unread is None else [found.unread]
            if id in on_sheet:
                cells.append(cell_of(found))
        report(id)
    if unread:
        warn(f"the page is without errors of {counted(len(unread), 'frame')}: {unread[0]}")
    _write_jpeg(folder / SHEET, contact_sheet(cells, scale))
    content = html_of(maps, frames, layers, scale, depth_range)
    while len(content) > MOST_BYTES and len(frames) > 2:  # where few frames misled the choice
        frames = frames[::2]
        content = html_of(maps, frames, layers, scale, depth_range)
    write_atomically(folder / PAGE, lambda file: file.write(content))
    return Page(folder / PAGE, len(maps.ids), len(frames), len(content))


def _write_preview(path: Path, depth: NDArray[np.float32], scale: Scale) -> None:
    small = resize_nearest(depth, size_within(depth.shape, PREVIEW_LONGEST))
    _write_jpeg(path, with_bar(coloured(small, scale, known=small > 0), scale))


def _write_jpeg(path: Path, image: Image.Image) -> None:
    write_atomically(path, lambda file: image.save(file, format="JPEG", quality=QUALITY))
