"""Frames side by side: each is too small for the cores to share."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

__all__ = ["side_by_side"]

_CHUNK = 8  # items of each thread: what is found of the next waits in memory

Item = TypeVar("Item")
Found = TypeVar("Found")


def side_by_side(
    function: Callable[[Item], Found], items: Sequence[Item], threads: int
) -> Iterator[Found]:
    """What a function finds of items, in their order, some computed at once.

    Args:
        function: may run in several threads at once.
        items: not many at a time are ahead of what is asked for.
        threads: 1 for none but this one.
    """
    if threads == 1:
        yield from map(function, items)
        return
    with ThreadPoolExecutor(threads, initializer=_alone) as pool:
        for start in range(0, len(items), threads * _CHUNK):
            yield from pool.map(function, items[start : start + threads * _CHUNK])


def _alone() -> None:
    """A thread of ours computes alone, as the others do: none waits for another."""
    torch.set_num_threads(1)
