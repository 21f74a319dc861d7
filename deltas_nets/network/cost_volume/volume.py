"""How much the sources differ from the anchor, for every pixel, at every inverse depth."""

import torch
from torch import Tensor

from deltas_geom import PosedViews, pixel_grid, resize_pixels, sample_inv_depths, sample_map
from deltas_geom.cameras.homogeneous import safe_divide


def difference_volume(
    maps: Tensor, views: PosedViews, inv_depths: Tensor, *, image_size: tuple[int, int]
) -> Tensor:
    """Mean absolute difference between the anchor's features and the sources', plane by plane.

    A plane that no source sees differs as much as the worst plane of the pixel; a pixel of which
    no source sees anything has 0 everywhere.

    Args:
        maps: ``(B, V, C, h, w)`` of all views, at any stride.
        views: their cameras, ``(B, V)``; view 0 is the anchor.
        inv_depths: ``(S,)`` of the planes, 1/m.
        image_size: (height, width) of the images.

    Returns:
        ``(B, S, h, w)``, in float32 at least.

    Source: Wang and Shen, MVDepthNet (2018), section 3.1.
    """
    height, width = maps.shape[-2:]
    planes, count = len(inv_depths), height * width
    centres = pixel_grid((height, width), device=maps.device, dtype=views.K.dtype)
    pixels = resize_pixels(centres, old_size=(height, width), new_size=image_size)
    pixels = pixels.expand(len(maps), count, 2)
    places = sample_inv_depths(views, pixels, inv_depths, image_size=image_size)
    of_anchor = maps[:, 0].flatten(-2).mT[:, :, None]
    total = of_anchor.new_zeros(len(maps), count, planes, dtype=views.K.dtype)
    seen = torch.zeros_like(total)
    # One source after the other: together they would need as many times the memory.
    for source in range(1, maps.shape[1]):
        at, mask = places.pixels[:, source - 1, :, 0], places.mask[:, source - 1, :, 0]
        read = sample_map(maps[:, source], at.flatten(1, 2), image_size=image_size)
        read = read.reshape(len(maps), count, planes, maps.shape[2])
        total = total + torch.where(mask, (read - of_anchor).abs().mean(dim=-1), 0.0)
        seen = seen + mask
    mean = safe_divide(total, seen, seen > 0)
    mean = torch.where(seen > 0, mean, mean.amax(dim=-1, keepdim=True))
    return mean.mT.reshape(len(maps), planes, height, width)
