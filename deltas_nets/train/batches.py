"""A step's rooms as the network sees them: on one kind of device, a function of config and step.

What is drawn for a room depends on its place in the step, not on who holds it, so a step can be
looked at without running those before. Everything happens on the device that the rooms are on, to
all of them at once.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from deltas_geom import PosedViews
from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.config import TrainConfig
from deltas_nets.datasets.augment import (
    Photometry,
    choose_views,
    disturb_poses,
    draw_pose_errors,
    first_views,
    mirror,
    resize,
)
from deltas_nets.train.loader import ALL, Part


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


class BatchMaker:
    """Turns rooms as rendered, or view sets as read, into a :class:`Batch` on their device.

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
