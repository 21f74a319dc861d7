"""Rooms to train on: rendered when asked for, kept on disk if a folder is given."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor
from torch.utils.data import Dataset

from deltas_geom.cameras.views import PosedViews
from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.outputs.atomic_files import write_atomically
from deltas_nets.rooms.close_up import draw_close_up
from deltas_nets.rooms.enlarged import as_large_as_rooms
from deltas_nets.rooms.render import render_view
from deltas_nets.rooms.scene import Room, draw_room
from deltas_nets.rooms.textures import texture_atlas

VERSION = 3
"""Raised whenever the same seed gives another room, so that no stale cache is read."""


def render_room(
    seed: int, *, num_views: int = 5, image_size: tuple[int, int] = (144, 192)
) -> PosedImages:
    """Draw the room of a seed and photograph it.

    Nothing but the arguments decides what comes out; no global generator is touched.
    Every pixel has a depth, and any of the views can serve as the anchor.

    Args:
        seed: not negative.
        num_views: V, 1 to 12.
        image_size: height, width.

    Returns:
        Images uint8 ``(V, 3, H, W)``, views of V cameras in float32, depth ``(V, H, W)``
        in metres.

    Example:
        >>> room = render_room(7, num_views=2, image_size=(48, 64))
        >>> room.images.shape, room.images.dtype, room.depth.shape
        (torch.Size([2, 3, 48, 64]), torch.uint8, torch.Size([2, 48, 64]))
    """
    return _photographed(draw_room, seed, num_views, image_size)


def render_close_up(
    seed: int, *, num_views: int = 5, image_size: tuple[int, int] = (144, 192)
) -> PosedImages:
    """As :func:`render_room`, of a desk, a shelf or a floor, 0.2 to 2 m away and a room behind.

    Example:
        >>> desk = render_close_up(7, num_views=2, image_size=(48, 64))
        >>> bool((desk.depth > 0.1).all()), bool((desk.depth.median() < 2))
        (True, True)
    """
    return _photographed(draw_close_up, seed, num_views, image_size)


class _Draw(Protocol):
    def __call__(
        self,
        seed: int,
        *,
        num_views: int,
        image_size: tuple[int, int],
        kinds: Mapping[str, tuple[int, ...]],
    ) -> tuple[Room, PosedViews]: ...


def _photographed(
    draw: _Draw, seed: int, num_views: int, image_size: tuple[int, int]
) -> PosedImages:
    atlas = texture_atlas()
    room, views = draw(seed, num_views=num_views, image_size=image_size, kinds=atlas.kinds)
    radiance, depth = zip(
        *(
            render_view(room, atlas, K, cam_from_world, image_size=image_size)
            for K, cam_from_world in zip(*views, strict=True)
        ),
        strict=True,
    )
    images = _expose(torch.stack(radiance), brightness=room.brightness)
    return PosedImages((images * 255).round().to(torch.uint8), views, torch.stack(depth))


class Rooms(Dataset[PosedImages]):
    """Item i is the room of ``seed + i``; a map-style data set for any ``DataLoader``.

    Args:
        num_rooms: how many.
        seed: of the first room; give training and validation ranges that do not overlap.
        num_views: cameras per room.
        image_size: height, width.
        close_ups: share of the rooms that are close-ups, enlarged as the network sees them.
        cache_dir: where rendered rooms are kept, about 1 MB each at the default size. Many
            processes may share it. ``None`` renders every time.
    """

    def __init__(
        self,
        num_rooms: int,
        *,
        seed: int = 0,
        num_views: int = 5,
        image_size: tuple[int, int] = (144, 192),
        close_ups: float = 0.0,
        cache_dir: Path | None = None,
    ) -> None:
        self.num_rooms = num_rooms
        self.seed = seed
        self.num_views = num_views
        self.image_size = image_size
        self.close_ups = close_ups
        self.cache_dir = cache_dir

    def __len__(self) -> int:
        return self.num_rooms

    def __getitem__(self, index: int) -> PosedImages:
        if not 0 <= index < self.num_rooms:
            # Also what ends a `for` loop over the data set.
            raise IndexError(f"room {index} of {self.num_rooms}")
        seed = self.seed + index
        near_by = bool(np.random.default_rng([seed, 2]).random() < self.close_ups)
        if not near_by:
            return self._rendered(render_room, "room", seed)
        return as_large_as_rooms(self._rendered(render_close_up, "close-up", seed), seed)

    def _rendered(self, render: Callable[..., PosedImages], name: str, seed: int) -> PosedImages:
        """Rendered, or read if it was rendered before."""

        def new() -> PosedImages:
            return render(seed, num_views=self.num_views, image_size=self.image_size)

        if self.cache_dir is None:
            return new()
        height, width = self.image_size
        path = self.cache_dir / (
            f"{name}-v{VERSION}-{self.num_views}x{height}x{width}-{seed}.safetensors"
        )
        try:
            return _read(path)
        except (OSError, SafetensorError, KeyError):  # not there, or damaged
            item = new()
            _write(item, path)
            return item


def _expose(radiance: Tensor, *, brightness: float) -> Tensor:
    """Scale radiance so that the mean over all views is ``brightness`` after clipping to 1."""
    images = radiance
    for _ in range(4):  # what is clipped is lost: a few steps make up for it
        images = (images * (brightness / images.mean())).clamp(0, 1)
    return images


def _read(path: Path) -> PosedImages:
    kept = load_file(path)
    return PosedImages(kept["images"], PosedViews(kept["K"], kept["cam_from_world"]), kept["depth"])


def _write(item: PosedImages, path: Path) -> None:
    """Whoever reads ``path`` finds all of it or nothing."""
    tensors = {
        "images": item.images,
        "K": item.views.K,
        "cam_from_world": item.views.cam_from_world,
        "depth": item.depth,
    }
    content = save({name: tensor.contiguous() for name, tensor in tensors.items()})
    write_atomically(path, lambda opened: opened.write(content))
