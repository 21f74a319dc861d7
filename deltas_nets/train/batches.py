"""What each training step sees: a function of the config and the step's number alone.

So a resumed run continues exactly, a step can be looked at without running those before, and
several processes see together what one would: each takes its part of every step's rooms, and
what is drawn for a room depends on its place in the step, not on who holds it.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Sampler

from deltas_geom import PosedViews
from deltas_nets.config import TrainConfig
from deltas_nets.data.augment import Photometry, choose_views, disturb_poses, mirror, resize
from deltas_nets.data.posed_images import PosedImages
from deltas_nets.data.synthetic import Rooms


class Part(NamedTuple):
    """Which of equal, consecutive parts of a step's rooms."""

    number: int = 0
    parts: int = 1

    def of(self, batch_size: int) -> range:
        """The places in a step whose rooms belong to this part."""
        size = batch_size // self.parts
        return range(self.number * size, (self.number + 1) * size)


ALL = Part()


class Batch(NamedTuple):
    """A step's input and truth.

    Attributes:
        images: ``(B, V, 3, H, W)`` in [0, 1].
        views: cameras as the network is told, with tracking errors.
        true_views: cameras as they were.
        depth: ``(B, V, H, W)`` metres.
        shift: ``(B, 2)`` of the spread keypoints.
    """

    images: Tensor
    views: PosedViews
    true_views: PosedViews
    depth: Tensor
    shift: Tensor

    def split(self, count: int) -> list["Batch"]:
        """Equal, consecutive parts; B is a multiple of ``count``."""
        size = len(self.images) // count
        return [self._rooms(slice(i * size, (i + 1) * size)) for i in range(count)]

    def _rooms(self, rooms: slice) -> "Batch":
        return Batch(
            self.images[rooms],
            PosedViews(*(tensor[rooms] for tensor in self.views)),
            PosedViews(*(tensor[rooms] for tensor in self.true_views)),
            self.depth[rooms],
            self.shift[rooms],
        )


class StepSampler(Sampler[list[int]]):
    """Rooms of the steps ``start .. stop``: every epoch a new order, the same for a seed."""

    def __init__(
        self,
        num_rooms: int,
        batch_size: int,
        *,
        seed: int,
        start: int,
        stop: int,
        part: Part = ALL,
    ) -> None:
        self.num_rooms = num_rooms
        self.batch_size = batch_size
        self.seed = seed
        self.steps = range(start, stop)
        self.part = part

    def __len__(self) -> int:
        return len(self.steps)

    def __iter__(self) -> Iterator[list[int]]:
        epoch, order = -1, torch.empty(0, dtype=torch.long)
        for step in self.steps:
            batch = []
            for place in self.part.of(self.batch_size):
                number = step * self.batch_size + place
                if number // self.num_rooms != epoch:
                    epoch = number // self.num_rooms
                    shuffle = torch.Generator().manual_seed(self.seed * 1_000_003 + epoch)
                    order = torch.randperm(self.num_rooms, generator=shuffle)
                batch.append(int(order[number % self.num_rooms]))
            yield batch


def room_loader(
    config: TrainConfig, *, start: int, stop: int, part: Part = ALL
) -> DataLoader[PosedImages]:
    """Rooms of the steps ``start .. stop``, read or rendered ahead."""
    data = config.data
    rooms = Rooms(
        data.num_rooms,
        seed=data.seed,
        num_views=data.num_views,
        image_size=(data.height, data.width),
        cache_dir=None if data.cache is None else Path(data.cache),
    )
    sampler = StepSampler(
        len(rooms), config.batch_size, seed=config.seed, start=start, stop=stop, part=part
    )
    return DataLoader(rooms, batch_sampler=sampler, num_workers=data.workers)


class BatchMaker:
    """Rooms as rendered to :class:`Batch`.

    Args:
        config: of the run.
        part: which of a step's rooms this process holds.
    """

    def __init__(self, config: TrainConfig, part: Part = ALL) -> None:
        self.config = config
        self.part = part
        self.photometry = Photometry()

    def __call__(self, rooms: PosedImages, step: int) -> Batch:
        """The batch of a step."""
        config = self.config
        # The number of views and the image size are common to a step's rooms, wherever they are.
        random = torch.Generator().manual_seed(_seed(config.seed, step))
        num_views = int(torch.randint(config.min_views, config.max_views + 1, (), generator=random))
        size = config.sizes[int(torch.randint(len(config.sizes), (), generator=random))]
        made = [
            self._room(room, num_views, size, _seed(config.seed, step, place))
            for room, place in zip(_one_by_one(rooms), self.part.of(config.batch_size), strict=True)
        ]
        return Batch(
            images=torch.cat([room.images for room in made]),
            views=PosedViews(*map(torch.cat, zip(*(room.views for room in made), strict=True))),
            true_views=PosedViews(
                *map(torch.cat, zip(*(room.true_views for room in made), strict=True))
            ),
            depth=torch.cat([room.depth for room in made]),
            shift=torch.cat([room.shift for room in made]),
        )

    def _room(self, room: PosedImages, num_views: int, size: tuple[int, int], seed: int) -> Batch:
        """A batch of one."""
        random = torch.Generator().manual_seed(seed)
        room = choose_views(room, num_views, random)
        room = room._replace(images=room.images.float() / 255)
        room = mirror(resize(room, size), torch.rand(1, generator=random) < 0.5)
        return Batch(
            images=self.photometry(room.images, seed),
            views=disturb_poses(room.views, self.config.pose_noise, random),
            true_views=room.views,
            depth=room.depth,
            shift=torch.rand(1, 2, generator=random),
        )


def _one_by_one(rooms: PosedImages) -> list[PosedImages]:
    """Batches of one room."""
    return [
        PosedImages(
            rooms.images[i : i + 1],
            PosedViews(*(tensor[i : i + 1] for tensor in rooms.views)),
            rooms.depth[i : i + 1],
        )
        for i in range(len(rooms.depth))
    ]


def _seed(*key: int) -> int:
    """A seed of a random stream of its own for every key."""
    return int(np.random.SeedSequence(key).generate_state(1)[0])
