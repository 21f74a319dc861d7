"""A depth map after it has heard the maps around it."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from deltas_geom import PosedViews
from deltas_nets.agree.consensus import consensus
from deltas_nets.agree.heard import Heard
from deltas_nets.agree.hidden import hidden
from deltas_nets.agree.seen_from import seen_from
from deltas_nets.network.correction import correction
from deltas_nets.network.known_depth import KnownDepth, as_points

EDGE = 0.1
"""Range of log depth within two pixels: there the map itself knows best where things end."""
MOST = 200
"""Places that tell how far the rest of the map is off."""


def agreed(own: KnownDepth, anchor: PosedViews, others: Sequence[Heard]) -> KnownDepth:
    """What several maps say where they do, and elsewhere the own map, moved as they would move it.

    Args:
        own: ``(1, H, W)``.
        anchor: its camera, ``(1)``.
        others: the maps that it hears.
    """
    if not others:
        return own
    size = (own.depth.shape[-2], own.depth.shape[-1])
    seen = [seen_from(*heard, anchor, image_size=size) for heard in others]
    told = consensus(
        KnownDepth(
            *(torch.cat([mine[None], *said]) for mine, *said in zip(own, *seen, strict=True))
        )
    )
    told = told._replace(
        depth=told.depth.masked_fill(hidden(own.depth, told.depth, anchor, others), 0.0)
    )
    there = own.depth > 0
    log_depth = torch.where(there, own.depth, 1.0).log()
    known = (told.depth > 0) & ~(there & _edges(log_depth))
    if not known.any():
        return own
    both = torch.where(known & there, told.depth, 0.0)
    points = as_points(KnownDepth(both[None], told.deviation[None]))
    process = correction(points, told.deviation[None].square(), log_depth[None], most=MOST)
    depth = torch.where(known, told.depth, own.depth).flatten()
    left = (there & ~known).flatten().nonzero()[:, 0]
    depth[left] *= process.at(left[None], log_depth[None])[0].exp()
    deviation = torch.where(known, told.deviation, own.deviation)
    return KnownDepth(depth.view(own.depth.shape), deviation)


def _edges(log_depth: Tensor) -> Tensor:
    highest = F.max_pool2d(log_depth, 5, stride=1, padding=2)
    lowest = -F.max_pool2d(-log_depth, 5, stride=1, padding=2)
    return highest - lowest > EDGE
