"""A teacher that looks at a picture from many sides, and keeps what it finds from most.

Source: DeTone et al., SuperPoint (2018), section 5: homographic adaptation.
"""

import torch
import torch.nn.functional as F
from kornia.geometry.transform import get_perspective_transform, warp_perspective
from torch import Tensor

from deltas_nets.distill.teachers import Teacher

_RIM = 4  # px inside of a warped picture's edge that the teacher may take for a line
_TURN, _ZOOM, _TILT, _SHIFT = 0.26, 1.4, 0.1, 0.1  # radians, factor, shares of the sides


def adapted_scores(
    teacher: Teacher, image: Tensor, *, looks: int, random: torch.Generator
) -> Tensor:
    """Mean of a teacher's score maps of warped copies of a picture, each warped back.

    A place that is found from one side only is no place to find again.

    Args:
        teacher: any.
        image: ``(1, 3, H, W)`` in [0, 1].
        looks: warps, at least 1; the first leaves the picture as it is.
        random: draws the others.

    Returns:
        ``(1, 1, H, W)`` in [0, 1].
    """
    size = (image.shape[-2], image.shape[-1])
    everywhere = torch.ones_like(image[:, :1])
    total, count = teacher(image), everywhere
    for _ in range(looks - 1):
        forth = random_homography(size, random).to(image)
        back = torch.linalg.inv(forth)
        warped = warp_perspective(image, forth, size, padding_mode="border")
        covered = warp_perspective(everywhere, forth, size) > 0.99
        inner = _eroded(covered.to(image.dtype), _RIM)
        total = total + warp_perspective(teacher(warped) * inner, back, size)
        count = count + warp_perspective(inner, back, size)
    return total / count


def random_homography(size: tuple[int, int], random: torch.Generator) -> Tensor:
    """A homography of pixels ``(1, 3, 3)``: turned, nearer or farther, tilted, shifted.

    Args:
        size: (height, width) of the picture.
        random: draws it.
    """
    height, width = size
    sides = torch.tensor([width, height], dtype=torch.float32)
    corners = torch.tensor([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * (sides - 1)
    turn, zoom = (2 * torch.rand(2, generator=random) - 1) * torch.tensor([_TURN, 1.0])
    cos, sin = turn.cos(), turn.sin()
    moved = _ZOOM**zoom * corners @ torch.stack([cos, sin, -sin, cos]).view(2, 2)
    tilt = _TILT * (2 * torch.rand(4, 2, generator=random) - 1)
    shift = _SHIFT * (2 * torch.rand(2, generator=random) - 1)
    centre = (sides - 1) / 2
    homography: Tensor = get_perspective_transform(
        (corners + centre)[None], (moved + (tilt + shift) * sides + centre)[None]
    )
    return homography


def _eroded(mask: Tensor, radius: int) -> Tensor:
    """1 where all pixels within the radius, those outside the image left out, are 1."""
    return 1 - F.max_pool2d(1 - mask, 2 * radius + 1, stride=1, padding=radius)
