"""Some of a capture's view sets, where all would take too long."""

from collections.abc import Sequence
from typing import TypeVar

__all__ = ["evenly_spaced"]

T = TypeVar("T")


def evenly_spaced(items: Sequence[T], count: int | None) -> list[T]:
    """At most so many, spread over all; every one if no count is given.

    Raises:
        ValueError: the count is below 1.

    Example:
        >>> evenly_spaced([10, 11, 12, 13, 14], 2)
        [10, 12]
    """
    if count is None or count >= len(items):
        return list(items)
    if count < 1:
        raise ValueError(f"count must be at least 1, got {count}")
    return [items[number * len(items) // count] for number in range(count)]
