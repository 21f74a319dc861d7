"""Rooms to train on: rendered when asked for, kept on disk if a folder is given."""

import os
import tempfile
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor
from torch.utils.data import Dataset

from deltas_geom.cameras.views import PosedViews
from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.rooms.render import render_view
from deltas_nets.rooms.scene import draw_room
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
    atlas = texture_atlas()
    room, views = draw_room(seed, num_views=num_views, image_size=image_size, kinds=atlas.kinds)
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
        cache_dir: Path | None = None,
    ) -> None:
        self.num_rooms = num_rooms
        self.seed = seed
        self.num_views = num_views
        self.image_size = image_size
        self.cache_dir = cache_dir

    def __len__(self) -> int:
        return self.num_rooms

    def __getitem__(self, index: int) -> PosedImages:
        if not 0 <= index < self.num_rooms:
            # Also what ends a `for` loop over the data set.
            raise IndexError(f"room {index} of {self.num_rooms}")
        seed = self.seed + index
        if self.cache_dir is None:
            return render_room(seed, num_views=self.num_views, image_size=self.image_size)
        height, width = self.image_size
        name = f"room-v{VERSION}-{self.num_views}x{height}x{width}-{seed}.safetensors"
        path = self.cache_dir / name
        if path.exists():
            return _read(path)
        item = render_room(seed, num_views=self.num_views, image_size=self.image_size)
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
    """Write under a temporary name first: whoever reads ``path`` finds all of it or nothing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    tensors = {
        "images": item.images,
        "K": item.views.K,
        "cam_from_world": item.views.cam_from_world,
        "depth": item.depth,
    }
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".writing-") as folder:
        temporary = Path(folder) / path.name
        save_file({name: tensor.contiguous() for name, tensor in tensors.items()}, temporary)
        os.replace(temporary, path)
