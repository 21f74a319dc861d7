"""Small text files that people write: a few words on each line, and comments."""

import codecs
import re
from collections.abc import Iterator
from pathlib import Path

from deltas_nets.errors import UserError

TEXT_LIMIT = 256 * 2**20
"""Bytes. Two million lines of poses are less."""


def in_commas(words: str) -> str:
    """What to add where numbers are expected and words hold decimal commas; else nothing.

    Example:
        >>> in_commas("0,5 -1,25")
        ' (decimal commas: write 0.5, not 0,5)'
    """
    found = re.search(r"(?:^|\s)-?\d+,\d+(?:e[+-]?\d+)?(?:\s|$)", words)
    return " (decimal commas: write 0.5, not 0,5)" if found else ""


def decoded(data: bytes) -> str:
    """The text of a file: UTF-8, or UTF-16 where its first bytes say so.

    Spreadsheets ("Unicode text") and PowerShell (what ``>`` writes) make the latter.

    Raises:
        UnicodeDecodeError: it is neither.

    Example:
        >>> decoded("fx: 9".encode("utf-16"))
        'fx: 9'
    """
    wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return data.decode("utf-16" if wide else "utf-8-sig")


def read_text(path: Path, *, name: str, remedy: str) -> str:
    """A text file within bounds.

    Args:
        path: the file.
        name: what it holds, for errors.
        remedy: what the user can do.

    Raises:
        UserError: it cannot be read, is no file, is larger than `TEXT_LIMIT`, or is not text.
    """
    try:
        size = path.stat().st_size
        if size > TEXT_LIMIT or not path.is_file():
            what = f"the {name} is no text file of less than {TEXT_LIMIT // 2**20} MiB"
            raise UserError(what, path, remedy)
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        what = f"the {name} cannot be read ({error.strerror or error})"
        raise UserError(what, path, remedy) from error
    except UnicodeDecodeError as error:
        raise UserError(f"the {name} is not text", path, remedy) from error


def read_lines(path: Path, *, name: str, remedy: str) -> Iterator[tuple[int, list[str]]]:
    """Numbers and words of the lines that are not empty; what follows a # is a comment.

    Raises:
        UserError: as `read_text`.
    """
    text = read_text(path, name=name, remedy=remedy)
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.partition("#")[0].split()
        if words:
            yield number, words


def read_numbers(path: Path, *, name: str, remedy: str) -> list[float]:
    """Numbers between spaces.

    Args:
        path: the file.
        name: what it holds, for errors.
        remedy: what the user can do.

    Raises:
        UserError: it is not text, or a word, which the error shows, is no number.
    """
    words = read_text(path, name=f"{name} file", remedy=remedy).split()
    numbers = []
    for word in words:
        try:
            numbers.append(float(word))
        except ValueError as error:
            what = f"the {name} file holds {word[:20]!r} where a number should be"
            what += in_commas(word)
            raise UserError(what, path, remedy) from error
    return numbers
