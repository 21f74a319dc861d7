"""Depth maps of other frames as the anchor would see them."""

import torch
from torch import Tensor

from deltas_geom import PosedViews
from deltas_geom.cameras.pixels import pixel_grid
from deltas_nets.agree.other_image import hit, motion
from deltas_nets.network.known_depth import KnownDepth


def seen_from(
    maps: KnownDepth,
    views: PosedViews,
    anchor: PosedViews,
    *,
    image_size: tuple[int, int],
) -> KnownDepth:
    """Every pixel of each map as a point, drawn into the anchor's image; the nearest wins.

    It is what :func:`deltas_geom.unproject`, :func:`deltas_geom.project` and
    :func:`deltas_geom.rasterize_depth` do, in fewer operations: for each pair of frames one matrix
    takes pixels to pixels.

    Args:
        maps: ``(V, 1, H, W)``.
        views: their cameras, ``(V)``.
        anchor: ``(1)``.
        image_size: (height, width) of the anchor's image.

    Returns:
        ``(V, 1, *image_size)``.
    """
    count, _, height, width = maps.depth.shape
    turn, shift = motion(views, anchor, like=maps.depth)
    grid = pixel_grid((height, width), dtype=maps.depth.dtype).to(maps.depth)
    homogeneous = torch.cat([grid, torch.ones_like(grid[:, :1])], dim=-1).mT
    depth = maps.depth.reshape(count, 1, -1)
    x, y, z = ((turn @ homogeneous).mul_(depth).add_(shift)).unbind(dim=1)
    place, inside = hit(x, y, z, image_size=image_size)
    return _nearest(maps, z, place, inside & (depth[:, 0] > 0), image_size)


def _nearest(
    maps: KnownDepth, z: Tensor, place: Tensor, inside: Tensor, image_size: tuple[int, int]
) -> KnownDepth:
    """Of the points of each map that fall on a pixel, the nearest.

    Args:
        maps: ``(V, 1, H, W)``, whose deviations the points have.
        z: ``(V, N)`` depth of the points.
        place: ``(V, N)`` of their pixels in the flat image.
        inside: ``(V, N)`` bool, which of them fall on one.
        image_size: of the result.
    """
    count, size = len(z), image_size[0] * image_size[1]
    nowhere = z.new_full((count, size + 1), torch.inf)  # what falls on no pixel goes to the last
    place = torch.where(inside, place, size)
    depth = nowhere.scatter_reduce(1, place, z, "amin")
    place = torch.where(z == depth.gather(1, place), place, size)
    # Of points of one depth the surest: which is drawn last is left open on a GPU.
    deviation = nowhere.scatter_reduce_(1, place, maps.deviation.reshape(count, -1), "amin")
    shape = (count, 1, *image_size)
    found = (part[:, :size].reshape(shape) for part in (depth, deviation))
    return KnownDepth(*(torch.where(part == torch.inf, 0.0, part) for part in found))
