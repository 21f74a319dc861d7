"""What most of several depth maps say, pixel by pixel."""

import torch

from deltas_nets.network.known_depth import KnownDepth

LEAST = 3
"""Maps that must agree."""
TOLERANCE = 0.08
"""By which the log of their depth may differ."""


def consensus(maps: KnownDepth) -> KnownDepth:
    """The mean of those that agree with one of them, the one whose followers are surest.

    Args:
        maps: ``(V, 1, H, W)`` as the anchor sees them.

    Returns:
        ``(1, H, W)``; unknown where fewer than `LEAST` agree. Maps of one network err together, so
        the deviation is not smaller than that of the mean map among them.
    """
    known = maps.depth > 0
    log_depth = torch.where(known, maps.depth, 1.0).log()
    precision = torch.where(known, maps.deviation.clamp_min(0.01) ** -2, 0.0)
    nothing = torch.zeros_like(log_depth[0])
    best, mean, variance = nothing, nothing, nothing
    for said, able in zip(log_depth, known, strict=True):
        agree = known & able & ((log_depth - said).abs() < TOLERANCE)
        share = precision * agree
        total = share.sum(dim=0)
        better = (agree.sum(dim=0) >= LEAST) & (total > best)
        share = share / total.clamp_min(1e-9)
        middle = (share * log_depth).sum(dim=0)
        spread = (share * (log_depth - middle).square()).sum(dim=0)
        usual = agree.sum(dim=0) / total.clamp_min(1e-9)
        best = torch.where(better, total, best)
        mean = torch.where(better, middle, mean)
        variance = torch.where(better, usual + spread, variance)
    return KnownDepth(torch.where(best > 0, mean.exp(), 0.0), variance.sqrt())
