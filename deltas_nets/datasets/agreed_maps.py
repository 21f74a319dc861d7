"""Maps that err as those on which several frames agreed, made of a map and the truth.

Their errors are those of the network that made the map, only smaller, and by another share in each
part of the image: neighbours correct each other where they see the same. Along edges of depth a map
hears little, and keeps most of its own error.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from deltas_nets.network.known_depth import KnownDepth

EDGE = 0.1
"""Range of log depth within two pixels of an edge, as where maps agree."""
LEFT, LEFT_AT_EDGES, LEAST = (0.15, 1.0), (0.5, 1.0), 0.05
"""Shares of the error that are left."""
UNEVEN = 0.25
"""Standard deviation by which that share differs between parts of the image."""
SCALE, BENT = 0.012, 0.008
"""Standard deviations of further errors of log depth: of the whole map, and of parts of it."""
STATED = (0.6, 1.1)
"""Stated deviations, as shares of the map's own."""
SEARCHED = (0.3, 13.0)
"""Metres within which the truth counts."""


def agreed_like(own: KnownDepth, depth: Tensor, random: torch.Generator) -> KnownDepth:
    """A map ``(B, 1, H, W)`` as if several frames had agreed on it.

    Args:
        own: ``(B, 1, H, W)`` map of a network.
        depth: ``(B, 1, H, W)`` true depth, metres, 0 = unknown.
        random: on the host, so that the result is the same whatever the device.
    """
    known = (depth > SEARCHED[0]) & (depth < SEARCHED[1])
    log_depth = own.depth.log()
    truth = torch.where(known, torch.where(known, depth, 1.0).log(), log_depth)
    highest = F.max_pool2d(log_depth, 5, stride=1, padding=2)
    lowest = -F.max_pool2d(-log_depth, 5, stride=1, padding=2)
    at_edge = highest - lowest > EDGE

    left = _shares(LEFT, own, random) + UNEVEN * _smooth(own, random)
    left = left.clamp(LEAST, 1.0)
    left = torch.where(at_edge, left.maximum(_shares(LEFT_AT_EDGES, own, random)), left)
    scale = torch.randn(len(depth), 1, 1, 1, generator=random).to(log_depth)
    further = SCALE * scale + BENT * _smooth(own, random)
    agreed = truth + left * (log_depth - truth) + torch.where(known, further, 0.0)
    stated = own.deviation * _shares(STATED, own, random)
    return KnownDepth(agreed.exp(), torch.where(at_edge, own.deviation, stated))


def _shares(between: tuple[float, float], like: KnownDepth, random: torch.Generator) -> Tensor:
    low, high = between
    drawn = torch.rand(len(like.depth), 1, 1, 1, generator=random)
    return (low + (high - low) * drawn).to(like.depth)


def _smooth(like: KnownDepth, random: torch.Generator) -> Tensor:
    """Noise ``(B, 1, H, W)`` of about unit variance that changes over a quarter of the image."""
    coarse = torch.randn(len(like.depth), 1, 4, 5, generator=random).to(like.depth)
    size = (like.depth.shape[-2], like.depth.shape[-1])
    return F.interpolate(coarse, size=size, mode="bicubic")
