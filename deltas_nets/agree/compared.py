"""A map moved to where other images show the same.

A few matches and the image itself decide a map. Here every pixel of it is compared with the frames
around, at a few depths within what its deviation leaves open.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from deltas_geom import PosedViews
from deltas_geom.cameras.pixels import pixel_grid
from deltas_nets.agree.other_image import NEAREST, Motion, motion
from deltas_nets.network.known_depth import KnownDepth

__all__ = ["Described", "compared"]

STEPS = (-2.0, -1.0, 0.0, 1.0, 2.0)
"""Depths that are compared, in the spreads below: of the log of depth, around the map's."""
SHARE = 0.5
"""Of a deviation: the spread within which the depth is sought. See decision 27."""
LEAST, MOST = 0.005, 0.04
"""Spread of the log of depth, at least and at most."""
SHARPNESS = 20.0
"""What a cosine of one weighs in the log of the likelihood."""
PIXELS = 1 << 12


class Described(NamedTuple):
    """An image by its descriptors.

    Attributes:
        rows: ``(h * w, D)`` of unit length, float32, row by row of the image.
        size: (h, w), two or more each.
        view: its camera, ``(1)``, at that size.
    """

    rows: Tensor
    size: tuple[int, int]
    view: PosedViews


class _Moved(NamedTuple):
    """By which the log of depth is to change, and what is left of its deviation, ``(N,)`` each."""

    by: Tensor
    narrower: Tensor


def compared(found: KnownDepth, anchor: Described, others: Sequence[Described]) -> KnownDepth:
    """The mean of the depths around each pixel's own, by how alike images are there.

    The prior is the map with a share of its deviation. The likelihood is the mean of the cosines of
    the images that see all of these depths; where none does, the map stays.

    Args:
        found: ``(1, H, W)``; what is 0 stays.
        anchor: its image.
        others: of the frames around, the more spread the better.

    Returns:
        ``(1, H, W)``. The deviation is the geometric mean of that before and that of the posterior,
        as what was searched is only a part of what may be wrong.
    """
    if not others:
        return found
    # Nearest: between a near and a far surface there is nothing at their mean.
    depth, deviation = (
        F.interpolate(part[None], size=anchor.size, mode="nearest-exact").flatten()
        for part in found
    )
    spread = (SHARE * deviation).clamp(LEAST, MOST)
    motions = [motion(anchor.view, other.view, like=depth) for other in others]
    pixels = pixel_grid(anchor.size, dtype=depth.dtype).to(depth)
    # Pixels some at a time: what is read of other images stays near the processor.
    cut = (torch.split(part, PIXELS) for part in (depth, spread, pixels, anchor.rows))
    moved = [
        _moved(z, within, at, rows, others, motions)
        for z, within, at, rows in zip(*cut, strict=True)
    ]
    size = (found.depth.shape[-2], found.depth.shape[-1])
    by, narrower = (
        F.interpolate(
            torch.cat(part).view(1, 1, *anchor.size),
            size=size,
            mode="bilinear",
            align_corners=False,
        )[0]
        for part in zip(*moved, strict=True)
    )
    return KnownDepth(found.depth * by.exp(), found.deviation * narrower.sqrt())


def _moved(
    depth: Tensor,
    spread: Tensor,
    pixels: Tensor,
    rows: Tensor,
    others: Sequence[Described],
    motions: Sequence[Motion],
) -> _Moved:
    steps = depth.new_tensor(STEPS)
    tried = depth[:, None] * (spread[:, None] * steps).exp()
    homogeneous = torch.cat([pixels, torch.ones_like(pixels[:, :1])], dim=-1).mT
    alike = torch.zeros_like(tried)
    count = torch.zeros_like(depth)
    for other, (turn, shift) in zip(others, motions, strict=True):
        rays = (turn[0] @ homogeneous)[..., None] * tried
        x, y, z = rays + shift[0, :, :, None]
        cosine, seen = _cosines(rows, other, x, y, z)
        alike += torch.where(seen[:, None], cosine, 0.0)
        count += seen
    likelihood = SHARPNESS * alike / count.clamp_min(1)[:, None]
    prior = -0.5 * steps.square()
    chosen = (likelihood + prior).softmax(dim=-1)
    mean = chosen @ steps
    left = (chosen * (steps - mean[:, None]).square()).sum(dim=-1).sqrt()
    before = (prior.softmax(dim=-1) @ steps.square()).sqrt()
    there = depth > 0
    return _Moved(torch.where(there, mean * spread, 0.0), torch.where(there, left / before, 1.0))


def _cosines(
    rows: Tensor, other: Described, x: Tensor, y: Tensor, z: Tensor
) -> tuple[Tensor, Tensor]:
    """How alike the other image is at places ``(N, K)``, and for which pixels all are in it.

    Args:
        rows: ``(N, D)`` descriptors of the pixels.
        other: the image.
        x: ``(N, K)`` times depth, pixels; the same of y.
        y: as x.
        z: depth.
    """
    height, width = other.size
    per_depth = z.clamp_min(NEAREST).reciprocal_()
    x, y = x * per_depth, y * per_depth
    # The depths of a pixel lie on a segment: what is true of its ends is true of all.
    ends = [torch.stack([part[:, 0], part[:, -1]]) for part in (x, y, z)]
    inside = _within(ends[0], width) & _within(ends[1], height) & (ends[2] > NEAREST)
    left, upper = x.floor().clamp_(0, width - 2), y.floor().clamp_(0, height - 2)
    right, lower = x.sub_(left).clamp_(0, 1), y.sub_(upper).clamp_(0, 1)
    first = upper.mul_(width).add_(left).int()
    places = first[..., None] + torch.tensor([0, 1, width, width + 1]).to(first)
    shares = torch.stack(
        [(1 - right) * (1 - lower), right * (1 - lower), (1 - right) * lower, right * lower], dim=-1
    )
    # A bag of four rows, weighed: bilinear reading at a tenth of the time of F.grid_sample.
    read = F.embedding_bag(
        places.view(-1, 4), other.rows, per_sample_weights=shares.view(-1, 4), mode="sum"
    )
    cosine = torch.bmm(read.view(*x.shape, -1), rows[..., None])[..., 0]
    return cosine, inside[0] & inside[1]


def _within(at: Tensor, size: int) -> Tensor:
    return (at > -0.5) & (at < size - 0.5)
