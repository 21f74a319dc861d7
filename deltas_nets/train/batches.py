"""What each training step sees: on one kind of device, a function of config and step alone.

So a resumed run continues exactly, a step can be looked at without running those before, and
several processes see together what one would: each takes its part of every step's rooms, and
what is drawn for a room depends on its place in the step, not on who holds it. A tuple of
ScanNet's frames counts as a room; reading it draws nothing. Rooms come as they are on disk, are
moved to the device that trains, and everything else happens there, to all of them at once.
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
    draw_pose_errors,
    first_views,
    mirror,
    resize,
)
from deltas_nets.data.posed_images import PosedImages
from deltas_nets.data.scannet_tuples import ScanNetTuples, open_scannet
from deltas_nets.data.synthetic import Rooms
from deltas_nets.errors import UserError
from deltas_nets.train.shelves import Shelves, places_with_new_rooms
from deltas_nets.train.stop import leave_to_the_trainer


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
    data: Rooms | ScanNetTuples,
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
        worker_init_fn=leave_to_the_trainer,
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
    """Errors as items: of one that a worker raises nothing but its traceback comes through."""

    def __init__(self, data: Rooms | ScanNetTuples) -> None:
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


class BatchMaker:
    """Rooms as rendered, or tuples as read, to :class:`Batch`, on the device they are on.

    Args:
        config: of the run.
        part: which of a step's rooms this process holds.
    """

    def __init__(self, config: TrainConfig, part: Part = ALL) -> None:
        self.config = config
        self.part = part
        self.photometry = Photometry()

    @torch.no_grad()
    def __call__(self, rooms: PosedImages, step: int) -> Batch:
        """The batch of a step."""
        config, device = self.config, rooms.images.device
        # The number of views and the image size are common to a step's rooms, wherever they are.
        random = torch.Generator().manual_seed(_seed(config.seed, step))
        num_views = int(torch.randint(config.min_views, config.max_views + 1, (), generator=random))
        size = config.sizes[int(torch.randint(len(config.sizes), (), generator=random))]
        places = self.part.of(config.batch_size)
        drawn = [
            _draw(config, num_views, rooms.depth.shape[1], _seed(config.seed, step, place))
            for place in places
        ]
        order, flips, errors, shift = (
            torch.stack(parts).to(device) for parts in zip(*drawn, strict=True)
        )
        if config.data.source == "rooms":
            rooms = choose_views(rooms, order)
        else:
            rooms = first_views(rooms, num_views)
        rooms = rooms._replace(images=rooms.images.float() / 255)
        rooms = mirror(resize(rooms, size), flips)
        images = self.photometry(
            rooms.images, _seed(config.seed, step), first=places.start, places=config.batch_size
        )
        return Batch(
            images=images,
            views=disturb_poses(rooms.views, errors),
            true_views=rooms.views,
            depth=rooms.depth,
            shift=shift,
            anchors=rooms.images[:, 0],
        )


class _Drawn(NamedTuple):
    """What chance decides about a room in a step."""

    order: Tensor
    """``(num_views,)`` int64, which of its views."""
    flip: Tensor
    """Bool scalar: mirrored."""
    errors: Tensor
    """``(num_views, 4, 4)`` motions of the poses."""
    shift: Tensor
    """``(2,)`` of the spread keypoints."""


def _draw(config: TrainConfig, num_views: int, available: int, seed: int) -> _Drawn:
    random = torch.Generator().manual_seed(seed)
    order = torch.randperm(available, generator=random)[:num_views]
    flip = torch.rand((), generator=random) < 0.5
    # Some trackers are better than others, and so are some moments.
    grade = float(torch.empty(()).uniform_(-1.4, 0.7, generator=random).exp())
    noise = (grade * config.pose_noise[0], grade * config.pose_noise[1])
    errors = draw_pose_errors(num_views, noise, random)
    return _Drawn(order, flip, errors, torch.rand(2, generator=random))


def _seed(*key: int) -> int:
    """A seed of a random stream of its own for every key."""
    return int(np.random.SeedSequence(key).generate_state(1)[0])
