"""Sparse points of our own format: points.csv, and observations.csv if one knows who sees them."""

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.points import Observations, SparsePoints
from deltas_nets.captures.readers.files import FileFinder
from deltas_nets.captures.readers.json_file import Fields
from deltas_nets.captures.readers.own_cameras import pixel_centre
from deltas_nets.captures.readers.own_table import REMEDY
from deltas_nets.captures.text_lines import decoded
from deltas_nets.errors import UserError

__all__ = ["read_points"]

POINTS = ("x", "y", "z", "r", "g", "b", "error")
"""Columns; all from the fourth on may be missing."""
OBSERVATIONS = ("point", "frame", "x", "y")
"""Columns: positions in points.csv and among the frames of the file, from 0, and the pixel."""


def read_points(
    root: Fields, folder: Path, ids: Sequence[str], frames: Frames, scales: FloatArray
) -> SparsePoints | None:
    """The points that the root names.

    Args:
        root: of the file.
        folder: of the capture.
        ids: of all frames of the file, in its order.
        frames: those that are used.
        scales: ``(len(ids), 2)`` right and down, of images from the cameras as stated.

    Raises:
        UserError: a file is missing or is no table of numbers.
    """
    if "points" not in root:
        return None
    table = _table(_file(root, "points", folder), POINTS, least=3)
    table = np.concatenate([table, np.full((len(table), 7 - table.shape[1]), np.nan)], axis=1)
    xyz = table[:, :3]
    if not np.isfinite(xyz).all():
        raise root.error("names points that are not finite")
    rgb = np.nan_to_num(table[:, 3:6]).clip(0, 255).astype(np.uint8)
    seen = Observations.none()
    if "observations" in root:
        seen = _observations(
            root, _file(root, "observations", folder), len(xyz), ids, frames, scales
        )
    return SparsePoints(xyz, rgb, table[:, 6], seen)


def _observations(
    root: Fields,
    file: Path,
    num_points: int,
    ids: Sequence[str],
    frames: Frames,
    scales: FloatArray,
) -> Observations:
    table = _table(file, OBSERVATIONS, least=4)
    point, frame = table[:, 0], table[:, 1]
    inside = (point >= 0) & (point < num_points) & (frame >= 0) & (frame < len(ids))
    if not inside.all() or (table[:, :2] % 1).any() or not np.isfinite(table).all():
        what = "an observation is of no point or no frame"
        raise UserError(what, file, "count both from 0, as they stand in their files")
    position = {id: place for place, id in enumerate(frames)}
    place = np.array([position.get(id, -1) for id in ids])[frame.astype(np.int64)]
    stated = table[:, 2:] - pixel_centre(root)
    # As K: the corner, half a pixel before the first centre, stays where it is.
    pixels = (stated + 0.5) * scales[frame.astype(np.int64)] - 0.5
    used = place >= 0
    return Observations(point.astype(np.int64)[used], place[used], pixels[used])


def _file(root: Fields, key: str, folder: Path) -> Path:
    name = root.text(key)
    file = FileFinder(folder, suffixes=(".csv", ".txt"), avoid=(".",)).find(name)
    if file is None:
        raise root.error(f"names {key} that are missing ({name[:80]})")
    return file


def _table(file: Path, columns: Sequence[str], *, least: int) -> FloatArray:
    """Numbers in the order of the columns; the first line may name them.

    As in frames.csv, decimal commas may be where semicolons or tabs stand between numbers.
    """
    names = ",".join(columns)
    try:
        lines = decoded(file.read_bytes()).splitlines()
        first = lines[0] if lines else ""
        mark = next((mark for mark in ";\t" if mark in first), ",")
        given = first.replace(" ", "").lower().split(mark)
        if not (least <= len(given) <= len(columns)):
            remedy = f"begin with a line {','.join(columns[:least])}, or {names}"
            raise UserError(f"the first line is {first[:40]!r}, not {names}", file, remedy)
        header = given == list(columns[: len(given)])
        if mark != ",":
            lines = [line.replace(",", ".") for line in lines]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # that there is no line
            table = np.loadtxt(lines, delimiter=mark, skiprows=int(header), ndmin=2)
    except UnicodeDecodeError as error:
        remedy = "save it as UTF-8 (spreadsheets: CSV UTF-8)"
        raise UserError("the file is not text in UTF-8", file, remedy) from error
    except ValueError as error:
        detail = " ".join(str(error).split())[:120]
        what = f"not every line is of the numbers {names} ({detail})"
        raise UserError(what, file, REMEDY) from error
    if table.size and table.shape[1] != len(given):
        raise UserError(f"the lines are not all of {names}", file, REMEDY)
    return table.reshape(-1, len(given))
