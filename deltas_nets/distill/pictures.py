"""Pictures that a teacher labels: views of procedural rooms, and crops of photographs."""

from collections.abc import Iterator

import torch
import torch.nn.functional as F
from torch import Tensor

from deltas_nets.config.distill import DistillConfig
from deltas_nets.rooms import Rooms
from deltas_nets.rooms.textures import GROUNDS, PICTURES, load_picture

IMAGE_SIZE = (192, 256)
"""Height and width of every picture."""
ROOM_VIEWS = 5
FIRST_ROOM, NUM_ROOMS = 1000, 2400  # as in training; validation rooms have seeds below 1000


def draw_pictures(config: DistillConfig) -> Iterator[Tensor]:
    """The pictures ``(3, H, W)`` uint8, a function of the config alone."""
    random = torch.Generator().manual_seed(config.seed)
    rooms = Rooms(
        NUM_ROOMS,
        seed=FIRST_ROOM,
        num_views=ROOM_VIEWS,
        image_size=IMAGE_SIZE,
        cache_dir=config.cache,
    )
    photographs = [load_picture(name) for name in (*PICTURES, *GROUNDS)]
    arrays = [torch.frombuffer(bytearray(p.tobytes()), dtype=torch.uint8) for p in photographs]
    sizes = [(p.height, p.width) for p in photographs]
    images = [a.view(*s, 3).permute(2, 0, 1) for a, s in zip(arrays, sizes, strict=True)]
    for _ in range(config.num_images):
        if float(torch.rand((), generator=random)) < config.picture_share:
            chosen = int(torch.randint(len(images), (), generator=random))
            picture = _random_crop(images[chosen], random)
        else:
            room = int(torch.randint(NUM_ROOMS, (), generator=random))
            view = int(torch.randint(ROOM_VIEWS, (), generator=random))
            picture = rooms[room].images[view]
        # Before the teacher looks: in a mirror it finds other points, not the same mirrored.
        yield picture.flip(-1) if float(torch.rand((), generator=random)) < 0.5 else picture


def _random_crop(image: Tensor, random: torch.Generator) -> Tensor:
    """A part of a photograph, of our shape, between a third and all of what fits."""
    height, width = image.shape[-2:]
    scale = min(height / IMAGE_SIZE[0], width / IMAGE_SIZE[1])
    scale *= 0.35 + 0.65 * float(torch.rand((), generator=random))
    rows, columns = (max(1, int(scale * side)) for side in IMAGE_SIZE)
    top = int(torch.randint(height - rows + 1, (), generator=random))
    left = int(torch.randint(width - columns + 1, (), generator=random))
    part = image[None, :, top : top + rows, left : left + columns].float()
    resized = F.interpolate(part, size=IMAGE_SIZE, mode="bilinear", antialias=True)
    return resized[0].round().clamp(0, 255).to(torch.uint8)
