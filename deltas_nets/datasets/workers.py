"""Processes that render or read ahead for another one."""

import os
from collections.abc import Iterator

from torch.utils.data import DataLoader, Dataset

from deltas_nets.captures.posed_images import PosedImages

MOST_WORKERS = 8


def leave_to_the_parent(worker: int) -> None:
    """Leave the group of the process that this one works for.

    Ctrl-C in a terminal, ``timeout`` and job schedulers send their signal to a whole group. It
    must not end those processes before the one that they work for is done; then it ends them.
    """
    if hasattr(os, "setpgrp"):  # not on Windows
        os.setpgrp()


def rendered_ahead(rooms: Dataset[PosedImages], count: int) -> Iterator[PosedImages]:
    """The first rooms in their order, while other processes render the next.

    Args:
        rooms: by number; what a room is depends on its number alone.
        count: how many.
    """
    workers = min(MOST_WORKERS, count, max(1, (os.cpu_count() or 1) - 1))
    loader: DataLoader[PosedImages] = DataLoader(
        rooms,
        batch_size=None,
        sampler=range(count),
        num_workers=workers,
        worker_init_fn=leave_to_the_parent,
    )
    yield from loader
