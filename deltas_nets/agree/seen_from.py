"""Depth maps of other frames as the anchor would see them."""

import torch
import torch.nn.functional as F
from torch import Tensor

from deltas_geom import PosedViews
from deltas_nets.agree.other_image import NEAREST, Motion, motion
from deltas_nets.network.known_depth import KnownDepth

FAR = 1e30
"""Farther than anything."""


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
    # One map at a time: what is computed of it stays near the processor.
    seen = [
        _nearest(KnownDepth(*found), Motion(turn, shift), image_size)
        for *found, turn, shift in zip(*maps, *motion(views, anchor, like=maps.depth), strict=True)
    ]
    return KnownDepth(*map(torch.stack, zip(*seen, strict=True)))


def _nearest(found: KnownDepth, moved: Motion, image_size: tuple[int, int]) -> KnownDepth:
    """Of the points of a map that fall on a pixel, the nearest.

    There are no bools in it, as each takes several times as long as a product: a point that
    nobody sees is `FAR` away, and one beside the image falls on a frame around it, which is cut.

    Args:
        found: ``(1, H, W)``.
        moved: ``(3, 3)`` and ``(3, 1)``, from its camera to the other one.
        image_size: (height, width) of the other image.

    Returns:
        ``(1, *image_size)``.
    """
    height, width = image_size
    x, y, z = torch.addcmul(moved.shift, _rays(moved.turn, found), found.depth.reshape(1, -1))
    per_depth = z.clamp_min(NEAREST).reciprocal_()
    column = (x * per_depth).add_(0.5).floor_().clamp_(-1, width)
    row = (y * per_depth).add_(0.5).floor_().clamp_(-1, height)
    place = row.add_(1).mul_(width + 2).add_(column.add_(1)).long()
    z = F.threshold(found.depth.flatten().sign() * z, NEAREST, FAR)
    nowhere = z.new_full(((height + 2) * (width + 2),), FAR)
    nearest = nowhere.scatter_reduce(0, place, z, "amin")
    # Of points of one depth the surest: which is drawn last is left open on a GPU.
    farther = z.sub_(nearest.gather(0, place))
    deviation = torch.add(found.deviation.flatten(), farther, alpha=FAR)
    deviation = nowhere.scatter_reduce_(0, place, deviation, "amin")
    known = nearest.clone().lt_(FAR)
    parts = (known * part for part in (nearest, deviation))
    return KnownDepth(*(part.view(1, height + 2, width + 2)[:, 1:-1, 1:-1] for part in parts))


def _rays(turn: Tensor, found: KnownDepth) -> Tensor:
    """``(3, H * W)``: ``turn @ (x, y, 1)`` of the pixels of a map."""
    height, width = found.depth.shape[-2:]
    row = torch.arange(height, dtype=turn.dtype, device=turn.device)
    column = torch.arange(width, dtype=turn.dtype, device=turn.device)
    of_row = turn[:, 1:2] * row + turn[:, 2:]
    return (of_row[..., None] + (turn[:, :1] * column)[:, None]).flatten(1)
