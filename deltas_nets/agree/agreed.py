"""A depth map after it has heard the maps around it."""

import torch
import torch.nn.functional as F
from torch import Tensor

from deltas_nets.agree.consensus import consensus
from deltas_nets.network.correction import Correction, Places, correction
from deltas_nets.network.known_depth import KnownDepth, as_points

EDGE = 0.1
"""Range of log depth within two pixels: there the map itself knows best where things end."""
MOST = 200
"""Places that tell how far the rest of the map is off."""


def agreed(own: KnownDepth, others: KnownDepth) -> KnownDepth:
    """What several maps say where they do, and elsewhere the own map, moved as they would move it.

    Args:
        own: ``(1, H, W)``.
        others: ``(V, 1, H, W)`` as the anchor sees them, see
            :func:`deltas_nets.agree.seen_from.seen_from`.
    """
    depth = torch.cat([own.depth[None], others.depth])
    deviation = torch.cat([own.deviation[None], others.deviation])
    told = consensus(KnownDepth(depth, deviation))
    known = (told.depth > 0) & ~_edges(own.depth)
    if not known.any():
        return own
    points = as_points(KnownDepth(torch.where(known, told.depth, 0.0)[None], told.deviation[None]))
    log_depth = own.depth.log()
    process = correction(points, told.deviation[None].square(), log_depth[None], most=MOST)
    moved = own.depth * _everywhere(process, log_depth).exp()
    return KnownDepth(
        torch.where(known, told.depth, moved), torch.where(known, told.deviation, own.deviation)
    )


def _edges(depth: Tensor) -> Tensor:
    log_depth = depth.log()
    highest = F.max_pool2d(log_depth, 5, stride=1, padding=2)
    lowest = -F.max_pool2d(-log_depth, 5, stride=1, padding=2)
    return highest - lowest > EDGE


def _everywhere(process: Correction, log_depth: Tensor) -> Tensor:
    """The correction of all pixels ``(1, H, W)``, some rows at a time."""
    index = torch.arange(log_depth.numel(), device=log_depth.device)
    parts = [
        process(Places.at(part[None], log_depth[None])) for part in torch.split(index, 1 << 14)
    ]
    return torch.cat(parts, dim=-1).reshape(log_depth.shape)
