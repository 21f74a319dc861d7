"""What most of several depth maps say, pixel by pixel."""

import torch
from torch import Tensor

from deltas_nets.network.known_depth import KnownDepth

LEAST = 3
"""Maps that must agree."""
TOLERANCE = 0.08
"""By which the log of their depth may differ."""
PIXELS = 1 << 13
NOWHERE = 1e6
"""Log depth of what is unknown."""
ASKED = 13
"""Maps that others agree with or not: the anchor's own and those that share most with it."""
SUREST = 0.01
"""Deviation below which no map is believed."""


def precision(deviation: Tensor) -> Tensor:
    """What a map's word is worth."""
    return deviation.clamp_min(SUREST) ** -2


def consensus(maps: KnownDepth) -> KnownDepth:
    """The mean of those that agree with one of them, the one whose followers are surest.

    Args:
        maps: ``(V, 1, H, W)`` as the anchor sees them.

    Returns:
        ``(1, H, W)``; unknown where fewer than `LEAST` agree. Maps of one network err together, so
        the deviation is not smaller than that of the mean map among them.
    """
    size = maps.depth.shape[1:]
    depth, deviation = maps.depth.flatten(1), maps.deviation.flatten(1)
    # Pixels some at a time: what is computed of them stays near the processor.
    parts = zip(*(torch.split(part, PIXELS, dim=1) for part in (depth, deviation)), strict=True)
    found = [_of_pixels(*part) for part in parts]
    return KnownDepth(*(torch.cat(columns).view(size) for columns in zip(*found, strict=True)))


def _of_pixels(depth: Tensor, deviation: Tensor) -> tuple[Tensor, Tensor]:
    """The consensus ``(N,)`` of maps ``(V, N)``, and its deviation."""
    known = depth > 0
    # What is unknown agrees with nothing that is known.
    log_depth = torch.where(known, depth.log(), NOWHERE)
    say = torch.where(known, precision(deviation), 0.0)
    summed = torch.stack([say, say * log_depth, torch.ones_like(say)])
    best, mean = torch.zeros_like(depth[0]), torch.zeros_like(depth[0])
    for said in log_depth[:ASKED]:
        agree = ((log_depth - said).abs_() < TOLERANCE).to(depth)
        total, weighted, count = (summed * agree).sum(dim=1)
        better = (count >= LEAST) & (total > best)
        best = torch.where(better, total, best)
        mean = torch.where(better, weighted / total.clamp_min(1e-9), mean)
    near = say * ((log_depth - mean).abs() < TOLERANCE)
    total = near.sum(dim=0).clamp_min(1e-9)
    spread = (near * (log_depth - mean).square()).sum(dim=0) / total
    usual = (near > 0).sum(dim=0) / total
    found = best > 0
    return torch.where(found, mean.exp(), 0.0), torch.where(found, (usual + spread).sqrt(), 0.0)
