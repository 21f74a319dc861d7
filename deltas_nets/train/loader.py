"""Which rooms each training step sees, read or rendered ahead: a function of config and step alone.

So a resumed run continues exactly, and several processes see together what one would: each takes
its part of every step's rooms. A tuple of ScanNet's frames counts as a room. Rooms come as they
are on disk and are moved to the device that trains.
"""

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch.utils.data import DataLoader, Dataset, Sampler, default_collate

from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.config import TrainConfig
from deltas_nets.datasets.scannet import ScanNetViewSets
from deltas_nets.datasets.workers import leave_to_the_parent
from deltas_nets.errors import UserError
from deltas_nets.rooms import Rooms
from deltas_nets.train.data_sets import training_data
from deltas_nets.train.shelves import Shelves, places_with_new_rooms


class Part(NamedTuple):
    """Which of equal, consecutive parts of a step's rooms."""

    number: int = 0
    parts: int = 1

    def of(self, batch_size: int) -> range:
        """The places in a step whose rooms belong to this part."""
        size = batch_size // self.parts
        return range(self.number * size, (self.number + 1) * size)


ALL = Part()


class StepSampler(Sampler[list[int]]):
    """New rooms of the steps ``start .. stop``: every epoch a new order, the same for a seed.

    Args:
        num_rooms: in an epoch.
        batch_size: places in a step.
        seed: of the orders.
        start: first step. With ``replay`` > 1 it may be negative: what comes before step 0 gives
            every place its first room.
        stop: the step after the last.
        part: whose places.
        replay: a place gets a new room in every so many steps; its places take turns.
    """

    def __init__(
        self,
        num_rooms: int,
        batch_size: int,
        *,
        seed: int,
        start: int,
        stop: int,
        part: Part = ALL,
        replay: int = 1,
    ) -> None:
        self.num_rooms = num_rooms
        self.batch_size = batch_size
        self.seed = seed
        self.steps = range(start, stop)
        self.part = part
        self.replay = replay

    def __len__(self) -> int:
        return len(self.steps)

    def __iter__(self) -> Iterator[list[int]]:
        epoch, order = -1, torch.empty(0, dtype=torch.long)
        per_step = self.batch_size // self.replay
        for step in self.steps:
            batch = []
            for place in places_with_new_rooms(step, self.part.of(self.batch_size), self.replay):
                number = (step + self.replay - 1) * per_step + place // self.replay
                if number // self.num_rooms != epoch:
                    epoch = number // self.num_rooms
                    shuffle = torch.Generator().manual_seed(self.seed * 1_000_003 + epoch)
                    order = torch.randperm(self.num_rooms, generator=shuffle)
                batch.append(int(order[number % self.num_rooms]))
            yield batch


def step_loader(
    data: Rooms | ScanNetViewSets,
    config: TrainConfig,
    *,
    start: int,
    stop: int,
    part: Part = ALL,
    device: torch.device | str = "cpu",
) -> Iterator[PosedImages]:
    """Rooms of the steps ``start .. stop`` on a device, read or rendered ahead by workers.

    Raises:
        UserError: one of them cannot be read.
    """
    if start >= stop:  # nothing to fill shelves for
        return
    places, replay = part.of(config.batch_size), config.data.replay
    shelves = Shelves(places, config.data.shelf, replay, seed=config.seed)
    first = shelves.first_step(start)
    sampler = StepSampler(
        len(data),
        config.batch_size,
        seed=config.seed,
        start=first,
        stop=stop,
        part=part,
        replay=replay,
    )
    loader: DataLoader[PosedImages | UserError | None] = DataLoader(
        _OrError(data),
        batch_sampler=sampler,
        num_workers=config.data.workers,
        collate_fn=_collate,
        worker_init_fn=leave_to_the_parent,
    )
    for step, rooms in enumerate(loader, first):
        if isinstance(rooms, UserError):
            raise rooms
        if rooms is not None:
            shelves.put(rooms.map(lambda tensor: tensor.to(device)), step)
        if step >= start:
            yield shelves.take(step)


def room_loader(
    config: TrainConfig, *, start: int, stop: int, part: Part = ALL
) -> Iterator[PosedImages]:
    """:func:`step_loader` of the config's own data."""
    return step_loader(training_data(config), config, start=start, stop=stop, part=part)


class _OrError(Dataset[PosedImages | UserError]):
    """Hands an error over as an item: raised in a worker, it would lose all but its traceback."""

    def __init__(self, data: Rooms | ScanNetViewSets) -> None:
        self.data = data

    def __getitem__(self, index: int) -> PosedImages | UserError:
        try:
            return self.data[index]
        except UserError as error:
            return error


def _collate(items: list[PosedImages | UserError]) -> PosedImages | UserError | None:
    for item in items:
        if isinstance(item, UserError):
            return item
    if not items:  # a step in which this process's places get no new room
        return None
    batch: PosedImages = default_collate(items)
    return batch
