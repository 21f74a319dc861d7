"""Threads of our own instead of torch's, which spin at every barrier beside a busy neighbour."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch

__all__ = ["own_threads"]


@contextmanager
def own_threads() -> Iterator[int]:
    """Torch uses one thread meanwhile; the value is how many it used before."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield before
    finally:
        torch.set_num_threads(before)
