"""Some of many, where all would take too long."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

__all__ = ["spread"]

Item = TypeVar("Item")


def spread(items: Sequence[Item], count: int) -> list[Item]:
    """At most so many of the items, evenly apart, the first and the last among them.

    Example:
        >>> spread("abcdefg", 4)
        ['a', 'c', 'e', 'g']
    """
    places = np.linspace(0, len(items) - 1, min(count, len(items)))
    return [items[round(place)] for place in places]
