"""The help of a command with many options, by what they are about."""

import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from textwrap import wrap
from typing import NamedTuple

__all__ = ["grouped_help"]

WIDEST = 100
_COLUMN = 24
"""Where texts begin."""
_EMPTY_DEFAULT = re.compile(r" ?\((?:default: (?:None|False|True)|required)\)")
"""Nothing that a text does not say better: options that are flags, or that follow from others."""


class _Option(NamedTuple):
    """An option as tyro shows it: its name and values, and what it does."""

    signature: str
    text: str

    @property
    def name(self) -> str:
        return self.signature.split(",")[0].split()[0]


def grouped_help(text: str, groups: Mapping[str, Sequence[str]]) -> str:
    """What tyro prints for ``--help``, its options taken apart, from boxes or between rules.

    Args:
        text: of tyro.
        groups: options by title, in order; what is in none comes last.

    Returns:
        The text as it is, where no options can be told apart in it; or where tyro has them in
        several boxes and nobody names groups.
    """
    before, *boxes = re.split(r"^(?:╭─| positional arg| options).*$", text, flags=re.MULTILINE)
    options = [option for box in boxes for option in _options(box)]
    if not options or (not groups and len(boxes) > 2):
        return text
    width = min(WIDEST, shutil.get_terminal_size((WIDEST, 24)).columns)
    paragraphs = re.split(r"\n\s*\n", before.strip())
    wrapped = [wrap(paragraph, width, break_on_hyphens=False) for paragraph in paragraphs]
    lines = ["\n\n".join(map("\n".join, wrapped))]
    for title, names in {**groups, "more" if groups else "options": ()}.items():
        listed = {name: place for place, name in enumerate(names)}
        mine = [option for option in options if option.name in listed]
        mine.sort(key=lambda option: listed[option.name])
        options = [option for option in options if option.name not in listed]
        shown = mine if names else options
        lines += ["", f"{title}:", *_lines(shown, width)] if shown else []
    return "\n".join(lines)


def _options(box: str) -> Iterator[_Option]:
    rows = [line.replace("│", " ").rstrip() for line in box.splitlines()]
    entries: list[list[str]] = []
    for row in rows:
        if re.match(r" {2}(?:-+\w|[A-Z]{2,}\b)", row):
            entries.append(re.split(r"\s{2,}", row.strip(), maxsplit=1))
        elif entries and row.startswith("   "):
            entries[-1].append(row.strip())
    for signature, *texts in entries:
        yield _Option(signature, _EMPTY_DEFAULT.sub("", " ".join(texts)))


def _lines(options: Sequence[_Option], width: int) -> Iterator[str]:
    for option in options:
        first = f"  {option.signature}  ".ljust(_COLUMN)
        beside = len(first) == _COLUMN
        if not beside:
            yield first.rstrip()
        yield from wrap(
            option.text,
            width,
            initial_indent=first if beside else " " * _COLUMN,
            subsequent_indent=" " * _COLUMN,
            break_on_hyphens=False,
        )
