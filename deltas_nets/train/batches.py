"""What each training step sees: a function of the config and the step's number alone.

So a resumed run continues exactly, a step can be looked at without running those before, and
several processes see together what one would: each takes its part of every step's rooms, and
what is drawn for a room depends on its place in the step, not on who holds it. A tuple of
ScanNet's frames counts as a room; reading it draws nothing.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler, Subset, default_collate

from deltas_geom import PosedViews
from deltas_nets.config import TrainConfig
from deltas_nets.data.augment import (
    Photometry,
    choose_views,
    disturb_poses,
    first_views,
    mirror,
    resize,
)
from deltas_nets.data.posed_images import PosedImages
from deltas_nets.data.scannet_tuples import ScanNetTuples, open_scannet
from deltas_nets.data.synthetic import Rooms
from deltas_nets.errors import UserError


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
        anchors: ``(B, 3, H, W)`` the anchors in the light they were taken in, for a teacher.
        labels: ``(B, 65, ceil(H/8), ceil(W/8))`` of a teacher, once it has looked.
    """

    images: Tensor
    views: PosedViews
    true_views: PosedViews
    depth: Tensor
    shift: Tensor
    anchors: Tensor
    labels: Tensor | None = None

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
            self.anchors[rooms],
            None if self.labels is None else self.labels[rooms],
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


def training_data(
    config: TrainConfig, *, report: Callable[[str], None] = lambda _: None
) -> Rooms | ScanNetTuples:
    """What the config wants to train on.

    Args:
        config: of the run.
        report: gets lines about what there is.

    Raises:
        UserError: there is none of it.
    """
    data = config.data
    if data.source == "scannet":
        return _frames(config, data.scannet.split, "--data.split", report)
    return Rooms(
        data.num_rooms,
        seed=data.seed,
        num_views=data.num_views,
        image_size=(data.height, data.width),
        cache_dir=None if data.cache is None else Path(data.cache),
    )


def validation_data(
    config: TrainConfig, *, report: Callable[[str], None] = lambda _: None
) -> Subset[PosedImages] | None:
    """Tuples of the validation split, spread evenly over it; None if the config names none.

    Raises:
        UserError: there is none.
    """
    scannet = config.data.scannet
    if scannet.validation is None:
        return None
    frames = _frames(config, scannet.validation, "--data.validation", report)
    count = min(scannet.validation_tuples, len(frames))
    return Subset(frames, [len(frames) * number // count for number in range(count)])


def _frames(
    config: TrainConfig, split: str, option: str, report: Callable[[str], None]
) -> ScanNetTuples:
    data = config.data
    return open_scannet(
        data.scannet,
        split,
        num_views=config.max_views,
        image_size=(data.height, data.width),
        cache=None if data.cache is None else Path(data.cache),
        option=option,
        report=report,
    )


def step_loader(
    data: Rooms | ScanNetTuples, config: TrainConfig, *, start: int, stop: int, part: Part = ALL
) -> Iterator[PosedImages]:
    """Rooms of the steps ``start .. stop``, read or rendered ahead by workers.

    Raises:
        UserError: one of them cannot be read.
    """
    sampler = StepSampler(
        len(data), config.batch_size, seed=config.seed, start=start, stop=stop, part=part
    )
    loader: DataLoader[PosedImages | UserError] = DataLoader(
        _OrError(data),
        batch_sampler=sampler,
        num_workers=config.data.workers,
        collate_fn=_collate,
    )
    for rooms in loader:
        if isinstance(rooms, UserError):
            raise rooms
        yield rooms


def room_loader(
    config: TrainConfig, *, start: int, stop: int, part: Part = ALL
) -> Iterator[PosedImages]:
    """:func:`step_loader` of the config's own data."""
    return step_loader(training_data(config), config, start=start, stop=stop, part=part)


class _OrError(Dataset[PosedImages | UserError]):
    """Errors as items: of one that a worker raises nothing but its traceback comes through."""

    def __init__(self, data: Rooms | ScanNetTuples) -> None:
        self.data = data

    def __getitem__(self, index: int) -> PosedImages | UserError:
        try:
            return self.data[index]
        except UserError as error:
            return error


def _collate(items: list[PosedImages | UserError]) -> PosedImages | UserError:
    for item in items:
        if isinstance(item, UserError):
            return item
    batch: PosedImages = default_collate(items)
    return batch


class BatchMaker:
    """Rooms as rendered, or tuples as read, to :class:`Batch`.

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
            anchors=torch.cat([room.anchors for room in made]),
        )

    def _room(self, room: PosedImages, num_views: int, size: tuple[int, int], seed: int) -> Batch:
        """A batch of one."""
        random = torch.Generator().manual_seed(seed)
        if self.config.data.source == "rooms":
            room = choose_views(room, num_views, random)
        else:
            room = first_views(room, num_views)
        room = room._replace(images=room.images.float() / 255)
        room = mirror(resize(room, size), torch.rand(1, generator=random) < 0.5)
        return Batch(
            images=self.photometry(room.images, seed),
            views=disturb_poses(room.views, self.config.pose_noise, random),
            true_views=room.views,
            depth=room.depth,
            shift=torch.rand(1, 2, generator=random),
            anchors=room.images[:, 0],
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
