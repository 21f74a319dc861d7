"""What several maps say of a pixel, but the anchor cannot see.

Maps of other frames look behind what stands in front of the anchor, and there they may well be many
that agree. An anchor sees the nearest thing. So where two depths are in question the nearer one is
believed, unless other maps look through the place where it would be.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom import PosedViews
from deltas_nets.agree.consensus import TOLERANCE, precision
from deltas_nets.agree.heard import Heard
from deltas_nets.agree.other_image import hit, motion
from deltas_nets.network.known_depth import KnownDepth

SAME = 0.16
"""Difference of log depth up to which a map supports a place: a vote for one of two, so it may be
wider than what is averaged."""
LOOKED_THROUGH = 4.0
"""How much more those that look through it may say than those that support it."""


class Votes(NamedTuple):
    """What maps say of points ``(N, 3)``.

    Attributes:
        support: ``(N,)`` precision of the maps that have their surface there.
        against: ``(N,)`` precision of those that see farther through the place.
    """

    support: Tensor
    against: Tensor


def hidden(own: Tensor, told: Tensor, anchor: PosedViews, others: Sequence[Heard]) -> Tensor:
    """Where the anchor does not see what is told.

    Args:
        own: ``(1, H, W)`` depth of the anchor's map.
        told: ``(1, H, W)`` depth that most maps say; 0 is unknown.
        anchor: its camera, ``(1)``.
        others: the maps.

    Returns:
        ``(1, H, W)`` bool. Farther than the own depth: hidden unless many look through that.
        Nearer: not there if more look through it than support it.
    """
    both = (own > 0) & (told > 0)
    ratio = torch.where(both, told, 1.0).log() - torch.where(both, own, 1.0).log()
    behind = (ratio > TOLERANCE).flatten().nonzero()[:, 0]
    before = (ratio < -TOLERANCE).flatten().nonzero()[:, 0]
    found = torch.zeros(own.numel(), dtype=torch.bool, device=own.device)
    kept = votes(own, behind, anchor, others)
    found[behind] = LOOKED_THROUGH * kept.support >= kept.against
    nearer = votes(told, before, anchor, others)
    found[before] = nearer.against > nearer.support
    return found.view(own.shape)


def votes(depth: Tensor, index: Tensor, anchor: PosedViews, others: Sequence[Heard]) -> Votes:
    """What maps say of some places of the anchor.

    Args:
        depth: ``(1, H, W)`` of the anchor.
        index: ``(N,)`` the places, in the flat image; their depth is positive.
        anchor: its camera, ``(1)``.
        others: the maps.
    """
    width = depth.shape[-1]
    z = depth.flatten()[index]
    pixels = torch.stack([index % width, index // width, torch.ones_like(index)]).to(depth)
    found = Votes(torch.zeros_like(z), torch.zeros_like(z))
    for maps, views in others:
        turn, shift = motion(anchor, views, like=depth)
        one = _votes(maps, (turn @ pixels) * z + shift)
        found = Votes(found.support + one.support, found.against + one.against)
    return found


def _votes(maps: KnownDepth, points: Tensor) -> Votes:
    """Of points ``(V, 3, N)`` in the maps' cameras, in pixels times depth."""
    x, y, z = points.unbind(dim=1)
    size = (maps.depth.shape[-2], maps.depth.shape[-1])
    place, inside = hit(x, y, z, image_size=size)
    there = maps.depth.flatten(1).gather(1, place)
    known = inside & (there > 0)
    off = torch.where(known, there, 1.0).log() - torch.where(known, z, 1.0).log()
    say = precision(maps.deviation.flatten(1).gather(1, place))
    agree, through = known & (off.abs() < SAME), known & (off >= SAME)
    return Votes((say * agree).sum(dim=0), (say * through).sum(dim=0))
