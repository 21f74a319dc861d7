"""Ids of frames: strings, sorted as people count, and how JSON and messages show them."""

import re
from bisect import bisect
from collections.abc import Iterable, Sequence

__all__ = ["id_in_json", "ids_in_words", "natural_key", "nearest_ids"]


def natural_key(id: str) -> tuple[str | int, ...]:
    """A key to sort by: numbers inside of ids count as numbers.

    Example:
        >>> sorted(["10", "2", "cam2/7", "cam10/1"], key=natural_key)
        ['2', '10', 'cam2/7', 'cam10/1']
    """
    # Words stand at even places and numbers at odd ones, so a word never meets a number.
    parts = re.split(r"(\d+)", id)
    return tuple(int(part) if place % 2 else part for place, part in enumerate(parts))


def nearest_ids(ids: Iterable[str], wanted: str, count: int = 4) -> Sequence[str]:
    """Ids around a place where one is missing, in order.

    Example:
        >>> nearest_ids(["1", "2", "3", "8", "9"], "7", count=2)
        ['3', '8']
    """
    known = sorted(ids, key=natural_key)
    place = bisect(known, natural_key(wanted), key=natural_key)
    first = max(0, min(place - count // 2, len(known) - count))
    return known[first : first + count]


def id_in_json(id: str) -> int | str:
    """An id as files of ours hold it: as a number where it is one.

    Example:
        >>> id_in_json("7"), id_in_json("007"), id_in_json("left")
        (7, '007', 'left')
    """
    return int(id) if re.fullmatch(r"0|-?[1-9][0-9]*", id) else id


def ids_in_words(ids: Iterable[str], limit: int = 5) -> str:
    """A few ids for an error message.

    Example:
        >>> ids_in_words(map(str, range(9)), limit=3)
        '0, 1, 2 and 6 more'
    """
    names = list(ids)
    more = f" and {len(names) - limit} more" if len(names) > limit else ""
    return ", ".join(names[:limit]) + more
