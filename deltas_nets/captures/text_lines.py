"""Small text files that people write: a few words on each line, and comments."""

from collections.abc import Iterator
from pathlib import Path

from deltas_nets.errors import UserError


def read_lines(path: Path, *, name: str, remedy: str) -> Iterator[tuple[int, list[str]]]:
    """Numbers and words of the lines that are not empty; what follows a # is a comment.

    Raises:
        UserError: the file cannot be read, or is not text.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        what = f"the {name} cannot be read ({error.strerror or error})"
        raise UserError(what, path, remedy) from error
    except UnicodeDecodeError as error:
        raise UserError(f"the {name} is not text", path, remedy) from error
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
    try:
        words = path.read_text(encoding="utf-8").split()
    except UnicodeDecodeError as error:
        raise UserError(f"the {name} file is not text", path, remedy) from error
    numbers = []
    for word in words:
        try:
            numbers.append(float(word))
        except ValueError as error:
            what = f"the {name} file holds {word[:20]!r} where a number should be"
            raise UserError(what, path, remedy) from error
    return numbers
