"""What our own format may say, and its CSV form brought to that of JSON.

`frames.json` is one object: keys of the root and a list of frames. `frames.csv` is the list: a
column is a key of a frame, a row a frame, and lines "# key: value" above it are keys of the root.
"""

import csv
import difflib
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from deltas_nets.captures.readers.json_file import Fields
from deltas_nets.errors import UserError

__all__ = [
    "CAMERA",
    "DEPTH_CAMERA",
    "FRAME",
    "REMEDY",
    "ROOT",
    "VERSION",
    "check_keys",
    "read_csv",
]

VERSION = 1
REMEDY = "see docs/captures.md for what it may hold"

CAMERA = ("fx", "fy", "cx", "cy", "width", "height", "lens", "coefficients")
"""Keys of a camera: at the root, in ``cameras``, or in a frame."""
DEPTH_CAMERA = ("fx", "fy", "cx", "cy", "width", "height", "cam_from_depth")
"""Keys of the camera of depth, where that is not the colour camera."""
FRAME = (
    *("id", "image", "cam_from_world", "world_from_cam", "camera", *CAMERA),
    *("depth", "depth_scale", "depth_camera", "depth_range", "sources"),
)
ROOT = (
    *("version", "units", "pixel_centres", *CAMERA, "cameras", "frames"),
    *("depth_scale", "depth_camera", "depth_range", "points", "observations"),
)
MEANT = {
    "k": "fx, fy, cx, cy",
    "intrinsics": "fx, fy, cx, cy",
    "intrinsic": "fx, fy, cx, cy",
    "camera_matrix": "fx, fy, cx, cy",
    "camera_intrinsics": "fx, fy, cx, cy",
    "file": "image",
    "filename": "image",
    "file_name": "image",
    "file_path": "image",
    "path": "image",
    "name": "image",
    "rgb": "image",
    "pose": "world_from_cam (camera-to-world) or cam_from_world",
    "extrinsics": "cam_from_world",
    "extrinsic": "cam_from_world",
    "transform_matrix": "world_from_cam, with axes x right, y down, z forward",
    "c2w": "world_from_cam",
    "w2c": "cam_from_world",
    "unit": "units",
    "scale": "units, or --scale of the command",
    "distortion": "lens and coefficients",
    "camera_model": "lens",
    "dist_coeffs": "lens and coefficients",
    "w": "width",
    "h": "height",
    "fl_x": "fx",
    "fl_y": "fy",
}
"""What keys of other programs are called here."""
_NUMBERS = ("fx", "fy", "cx", "cy", "width", "height", "version", "depth_scale")
_LISTS = ("coefficients", "cam_from_world", "world_from_cam", "depth_range")
FILE_LIMIT = 256 * 2**20
"""Bytes."""


def check_keys(fields: Fields, known: Iterable[str]) -> None:
    """Refuse keys that nobody would read.

    Raises:
        UserError: there is one; the nearest known key is named.
    """
    wrong = next((key for key in fields.values if key not in known), None)
    if wrong is None:
        return
    near = difflib.get_close_matches(wrong.lower(), known, n=1, cutoff=0.6)
    meant = MEANT.get(wrong.lower()) or (near[0] if near else None)
    remedy = f"did you mean {meant}?" if meant else f"known are {', '.join(known)}"
    raise UserError(f"{fields.where} has an unknown key {wrong[:40]!r}", fields.path, remedy)


def read_csv(path: Path) -> dict[str, object]:
    """The same as JSON would hold.

    Raises:
        UserError: it cannot be read, is too large, empty or no text, or a row has more cells than
            the first.
    """
    try:
        if path.stat().st_size > FILE_LIMIT:
            raise UserError(f"the file has more than {FILE_LIMIT >> 20} MiB", path, REMEDY)
        lines = path.read_bytes().decode("utf-8-sig").splitlines()
    except OSError as error:
        what = f"the file cannot be read ({error.strerror or error})"
        raise UserError(what, path, REMEDY) from error
    except UnicodeDecodeError as error:
        raise UserError("the file is not text in UTF-8", path, REMEDY) from error
    if not any(line.strip() for line in lines):
        raise UserError("the file is empty", path, REMEDY)
    delimiter, lines = _delimiter(lines)
    commas = delimiter != ","  # decimal ones are in files of countries that have them
    root: dict[str, object] = {}
    for line in lines:
        # Spreadsheets fill every line up to the width of the table.
        stated = re.fullmatch(r"#\s*(\w+)\s*:\s*(.*?)\s*", line.rstrip(delimiter))
        if stated:
            root[stated[1]] = _value(stated[1], stated[2], commas)
    try:
        table = csv.reader(_rows(lines), delimiter=delimiter)
        rows = [row for row in table if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise UserError(f"the file is no CSV ({error})", path, REMEDY) from error
    header = [name.strip() for name in rows[0]] if rows else []
    if len(set(header)) < len(header):
        raise UserError("two columns have one name", path, REMEDY)
    for number, row in enumerate(rows[1:]):
        if len(row) != len(header):
            what = f"row {number} has {len(row)} cells, the first line {len(header)}"
            raise UserError(what, path, REMEDY)
    root["frames"] = [_frame(dict(zip(header, row, strict=True)), commas) for row in rows[1:]]
    return root


def _delimiter(lines: list[str]) -> tuple[str, list[str]]:
    """What stands between cells, and the lines without the one that says it, as Excel's may."""
    stated = re.fullmatch(r"sep=([,;\t])", lines[0].strip(" \r\n"))
    if stated:
        return stated[1], lines[1:]
    # Spreadsheets of countries with decimal commas put semicolons; what is copied has tabs.
    header = next(iter(_rows(lines)), "")
    return next((mark for mark in ",;\t" if mark in header), ","), lines


def _rows(lines: list[str]) -> list[str]:
    """The lines that are no comments and not empty."""
    return [line for line in lines if line.strip() and not line.startswith("#")]


def _frame(row: Mapping[str, str], commas: bool) -> dict[str, object]:
    """A row as JSON would hold it; empty cells say nothing."""
    return {key: _value(key, cell, commas) for key, cell in row.items() if cell.strip()}


def _value(key: str, cell: str, commas: bool) -> object:
    """Cells that should be numbers become such; others stay words, which are refused later."""
    cell = cell.strip()
    if key == "sources":
        return cell.split()
    if key not in (*_NUMBERS, *_LISTS):
        return cell
    try:
        numbers = [float(word.replace(",", ".") if commas else word) for word in cell.split()]
    except ValueError:
        return cell
    return numbers if key in _LISTS or len(numbers) != 1 else numbers[0]
