"""What most of several depth maps say, pixel by pixel."""

import torch
from torch import Tensor

from deltas_nets.network.known_depth import KnownDepth

LEAST = 3
"""Maps that must agree."""
TOLERANCE = 0.08
"""By which the log of their depth may differ."""
PIXELS = 1 << 13
TINY = 1e-37
"""Stands for a depth that is unknown: nothing that is known is near it."""
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
    # Ones and zeros rather than bools, and no log of 0: each takes several times as long.
    known = depth.sign()
    log_depth = depth.clamp_min(TINY).log()
    say = precision(deviation) * known
    centre, followers = _surest(log_depth[:1], log_depth, say)
    # Mostly all agree with the first map: nobody has more followers.
    left = (followers < known.sum(dim=0)).nonzero()[:, 0]
    centre[left] = _surest(log_depth[:ASKED, left], log_depth[:, left], say[:, left])[0]
    off, near, total = _near(log_depth - centre, say)
    mean = centre + (near * off).sum(dim=0) / total
    off, near, total = _near(log_depth - mean, say)
    spread = (near * off.square()).sum(dim=0) / total
    usual = near.sign().sum(dim=0) / total
    found = centre < torch.inf
    return torch.where(found, mean.exp(), 0.0), torch.where(found, (usual + spread).sqrt(), 0.0)


def _surest(asked: Tensor, log_depth: Tensor, say: Tensor) -> tuple[Tensor, Tensor]:
    """Of maps ``(A, N)`` the log depth ``(N,)`` whose followers are surest, and how many follow.

    Infinity and 0 where too few do.
    """
    total, count = torch.zeros_like(asked), torch.zeros_like(asked)
    for said, worth in zip(log_depth, say, strict=True):
        agree = (asked - said).abs_().lt_(TOLERANCE)
        total.addcmul_(agree, worth)
        count += agree
    best, which = torch.where(count >= LEAST, total, 0.0).max(dim=0)
    centre, followers = (part.gather(0, which[None])[0] for part in (asked, count))
    enough = best > 0
    return torch.where(enough, centre, torch.inf), torch.where(enough, followers, 0.0)


def _near(off: Tensor, say: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """How far maps are off, what those within the tolerance say, and the sum of that."""
    near = off.abs().lt_(TOLERANCE).mul_(say)
    return off, near, near.sum(dim=0).clamp_min_(1e-9)
