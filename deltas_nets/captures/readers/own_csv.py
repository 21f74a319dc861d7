"""frames.csv brought to the form of frames.json.

The table is the list of frames: a column is a key of a frame, a row a frame. Lines "# key: value"
are keys of the root. People make such tables by hand, in spreadsheets and by programs, so errors
count lines as editors do, and say what a cell holds.
"""

import csv
import difflib
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from deltas_nets.captures.readers.own_table import FRAME, MEANT, REMEDY, ROOT
from deltas_nets.captures.text_lines import decoded, in_commas
from deltas_nets.errors import UserError

__all__ = ["read_csv"]

_NUMBERS = ("fx", "fy", "cx", "cy", "width", "height", "version", "depth_scale")
_LISTS = ("coefficients", "cam_from_world", "world_from_cam", "depth_range")
_NO_COLUMNS = ("camera", "depth_camera")
"""Keys of frames for which a table has no place: objects, and names of objects."""
_HEADER = (
    "name the columns above it, as image,fx,fy,cx,cy,world_from_cam, and begin comments with #"
)
FILE_LIMIT = 256 * 2**20
"""Bytes."""


class _Row(NamedTuple):
    """Cells, and the lines of the file from which to which they stand."""

    cells: list[str]
    first: int
    last: int


class _Form(NamedTuple):
    """How the file is written: what stands between cells, and whether numbers may have commas."""

    path: Path
    delimiter: str

    @property
    def commas(self) -> bool:
        """Decimal ones are in files of countries that have them, with other marks between cells."""
        return self.delimiter != ","


def read_csv(path: Path) -> dict[str, object]:
    """The same as JSON would hold.

    Raises:
        UserError: it cannot be read, is too large, empty or no text, its first line names no
            column, a row has more cells than that, or a cell is no number where one should be.
    """
    lines = _lines(path)
    form, lines = _form(path, lines)
    root: dict[str, object] = {}
    for number, line in enumerate(lines, start=1):
        if _is_comment(line):
            root |= _stated(line, number, form)
    try:
        rows = list(_rows(lines, form))
    except csv.Error as error:
        raise UserError(f"the file is no CSV ({error})", path, REMEDY) from error
    header = _header(rows[0], form) if rows else []
    root["frames"] = [_frame(header, row, form) for row in rows[1:]]
    return root


def _lines(path: Path) -> list[str]:
    """The lines with their ends, which a quoted cell may hold."""
    try:
        if path.stat().st_size > FILE_LIMIT:
            raise UserError(f"the file has more than {FILE_LIMIT >> 20} MiB", path, REMEDY)
        lines = decoded(path.read_bytes()).splitlines(keepends=True)
    except OSError as error:
        what = f"the file cannot be read ({error.strerror or error})"
        raise UserError(what, path, REMEDY) from error
    except UnicodeDecodeError as error:
        remedy = "save it as UTF-8 (spreadsheets: CSV UTF-8)"
        raise UserError("the file is not text in UTF-8", path, remedy) from error
    if not any(line.strip() for line in lines):
        raise UserError("the file is empty", path, REMEDY)
    return lines


def _form(path: Path, lines: list[str]) -> tuple[_Form, list[str]]:
    """How the file is written, and the lines, that which says it emptied, as Excel's may."""
    stated = re.fullmatch(r"sep=([,;\t])", lines[0].strip(" \r\n").lower())
    if stated:
        return _Form(path, stated[1]), ["\n", *lines[1:]]
    # Spreadsheets of countries with decimal commas put semicolons; what is copied has tabs.
    header = next((line for line in lines if line.strip() and not _is_comment(line)), "")
    return _Form(path, next((mark for mark in ",;\t" if mark in header), ",")), lines


def _is_comment(line: str) -> bool:
    """Whether the first cell begins with #; spreadsheets quote one that holds what divides cells.

    A quoted "#1.jpg" is the name of an image.
    """
    return bool(re.match(r'\s*(#|"\s*#\s)', line))


def _stated(line: str, number: int, form: _Form) -> dict[str, object]:
    """The key of the root that a comment states, if it states one.

    A sheet may have the value in the next cell, or fill the line up to the width of the table.
    """
    try:
        cells = next(csv.reader([line], delimiter=form.delimiter))
    except csv.Error:
        return {}
    words = " ".join(cell.strip() for cell in cells if cell.strip())
    stated = re.fullmatch(r"#\s*(\w+)\s*:\s*(.*?)\s*", words)
    if not stated:
        return {}
    key, value = stated.groups()
    # "# author: me" is a comment; what is nearly a key is kept, to be refused by its name.
    if not difflib.get_close_matches(key.lower(), (*ROOT, *MEANT), n=1, cutoff=0.7):
        return {}
    return {key: _value(key, value, number, form)}


def _rows(lines: list[str], form: _Form) -> Iterator[_Row]:
    """The rows that are no comments and not empty."""
    table = csv.reader(
        ("\n" if _is_comment(line) else line for line in lines), delimiter=form.delimiter
    )
    last = 0
    for cells in table:
        first, last = last + 1, table.line_num
        if any(cell.strip() for cell in cells):
            yield _Row(cells, first, last)


def _header(row: _Row, form: _Form) -> list[str]:
    names = [name.strip() for name in row.cells]
    if not any(name in FRAME or name.lower() in (*FRAME, *MEANT) for name in names):
        what = f"line {row.first} names no column that is known ({form.delimiter.join(names)[:40]})"
        raise UserError(what, form.path, _HEADER)
    named = [name for name in names if name]
    if len(set(named)) < len(named):
        raise UserError("two columns have one name", form.path, REMEDY)
    without_place = next((name for name in names if name in _NO_COLUMNS), None)
    if without_place is not None:
        remedy = "give fx, fy, cx and cy a column each, or write frames.json"
        raise UserError(f"a table has no place for a {without_place}", form.path, remedy)
    while names and not names[-1]:
        names.pop()
    return names


def _frame(header: list[str], row: _Row, form: _Form) -> dict[str, object]:
    """A row as JSON would hold it; empty cells say nothing."""
    cells = list(row.cells)
    while len(cells) > len(header) and not cells[-1].strip():
        cells.pop()
    if len(cells) != len(header):
        raise _other_width(len(cells), len(header), row, form)
    said: Mapping[str, str] = dict(zip(header, cells, strict=True))
    return {key: _value(key, cell, row.first, form) for key, cell in said.items() if cell.strip()}


def _other_width(cells: int, columns: int, row: _Row, form: _Form) -> UserError:
    what = f"line {row.first} has {cells} cells, the line of the columns {columns}"
    remedy = "give every column a cell, which may be empty"
    if row.last > row.first:
        what = f"the row of line {row.first} goes on to line {row.last}: a quote is not closed"
        remedy = "close it, or leave it out"
    elif cells > columns and not form.commas:
        remedy = "write 0.5, not 0,5, or put semicolons between cells; quote names with commas"
    return UserError(what, form.path, remedy)


def _value(key: str, cell: str, line: int, form: _Form) -> object:
    """A cell as JSON would hold it: words, a number or a list of numbers."""
    cell = cell.strip()
    if key == "sources":
        return cell.split()
    if key not in (*_NUMBERS, *_LISTS):
        return cell
    # Programs write their lists into cells as they print them: [1.0, 0.5].
    words = re.sub(r"[\[\]]|,(?=\s)", " ", cell) if key in _LISTS else cell
    numbers = []
    for word in words.split():
        try:
            numbers.append(float(word.replace(",", ".") if form.commas else word))
        except ValueError as error:
            what = f"line {line} has a {key} in which {word[:40]!r} is no number{in_commas(word)}"
            remedy = "write numbers, with spaces between" if key in _LISTS else "write a number"
            raise UserError(what, form.path, remedy) from error
    return numbers if key in _LISTS or len(numbers) != 1 else numbers[0]
