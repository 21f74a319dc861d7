"""What each training step sees: a function of the config and the step's number alone.

So a resumed run continues exactly, and a step can be looked at without running those before.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.data import DataLoader, Sampler

from deltas_geom import PosedViews
from deltas_nets.config import TrainConfig
from deltas_nets.data.augment import Photometry, choose_views, disturb_poses, mirror, resize
from deltas_nets.data.posed_images import PosedImages
from deltas_nets.data.synthetic import Rooms


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


class StepSampler(Sampler[list[int]]):
    """Rooms of the steps ``start .. stop``: every epoch a new order, the same for a seed."""

    def __init__(
        self, num_rooms: int, batch_size: int, *, seed: int, start: int, stop: int
    ) -> None:
        self.num_rooms = num_rooms
        self.batch_size = batch_size
        self.seed = seed
        self.steps = range(start, stop)

    def __len__(self) -> int:
        return len(self.steps)

    def __iter__(self) -> Iterator[list[int]]:
        epoch, order = -1, torch.empty(0, dtype=torch.long)
        for step in self.steps:
            batch = []
            for number in range(step * self.batch_size, (step + 1) * self.batch_size):
                if number // self.num_rooms != epoch:
                    epoch = number // self.num_rooms
                    shuffle = torch.Generator().manual_seed(self.seed * 1_000_003 + epoch)
                    order = torch.randperm(self.num_rooms, generator=shuffle)
                batch.append(int(order[number % self.num_rooms]))
            yield batch


def room_loader(config: TrainConfig, *, start: int, stop: int) -> DataLoader[PosedImages]:
    """Rooms of the steps ``start .. stop``, read or rendered ahead."""
    data = config.data
    rooms = Rooms(
        data.num_rooms,
        seed=data.seed,
        num_views=data.num_views,
        image_size=(data.height, data.width),
        cache_dir=None if data.cache is None else Path(data.cache),
    )
    sampler = StepSampler(len(rooms), config.batch_size, seed=config.seed, start=start, stop=stop)
    return DataLoader(rooms, batch_sampler=sampler, num_workers=data.workers)


class BatchMaker:
    """Rooms as rendered to :class:`Batch`."""

    def __init__(self, config: TrainConfig) -> None:
        self.config = config
        self.photometry = Photometry()

    def __call__(self, rooms: PosedImages, step: int) -> Batch:
        """The batch of a step."""
        config = self.config
        seed = config.seed * 1_000_003 + step
        random = torch.Generator().manual_seed(seed)
        num_views = int(torch.randint(config.min_views, config.max_views + 1, (), generator=random))
        size = config.sizes[int(torch.randint(len(config.sizes), (), generator=random))]
        rooms = choose_views(rooms, num_views, random)
        rooms = rooms._replace(images=rooms.images.float() / 255)
        rooms = mirror(resize(rooms, size), torch.rand(len(rooms.depth), generator=random) < 0.5)
        return Batch(
            images=self.photometry(rooms.images, seed),
            views=disturb_poses(rooms.views, config.pose_noise, random),
            true_views=rooms.views,
            depth=rooms.depth,
            shift=torch.rand(len(rooms.depth), 2, generator=random),
        )
