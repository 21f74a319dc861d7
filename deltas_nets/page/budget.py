"""How many frames a page shows, and how large, so that it opens quickly and can be sent by mail."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from deltas_nets.captures.spread import spread
from deltas_nets.page.pictures import LONGEST

__all__ = ["MOST_BYTES", "Chosen", "choose"]

MOST_BYTES = 14_000_000
"""Of the page."""
SMALLER = (LONGEST, 480, 320)
"""Longer sides of pictures; below the last, frames are left out instead."""
MEASURED = 6
"""Frames whose pictures are made to learn how many bytes they take."""
MARGIN = 1.15
"""Other frames may take more than those."""


class Chosen(NamedTuple):
    """What a page shows.

    Attributes:
        ids: of frames, evenly spread over all.
        longest: pixels of the longer side of their pictures.
    """

    ids: tuple[str, ...]
    longest: int


def choose(ids: Sequence[str], room: int, bytes_of: Callable[[str, int], int]) -> Chosen:
    """All frames as large as there is room for; where there is none, some of them, small.

    Args:
        ids: of all frames, at least one.
        room: bytes.
        bytes_of: how many a frame takes with pictures of a size.

    Example:
        >>> choose("abcdefgh", 400, lambda id, longest: longest // 4)
        Chosen(ids=('a', 'c', 'f', 'h'), longest=320)
    """
    for longest in SMALLER:
        measured = [bytes_of(id, longest) for id in spread(ids, MEASURED)]
        each = MARGIN * sum(measured) / len(measured)
        if each * len(ids) <= room:
            return Chosen(tuple(ids), longest)
    return Chosen(tuple(spread(ids, max(2, int(room / each)))), longest)
