"""A map held to what was measured of its frame.

Maps that agree know nothing of a sensor: each of them took what it measured for one witness more.
Of its own frame a sensor knows better than the maps of others, where they do not contradict it.
"""

import itertools

import torch
import torch.nn.functional as F
from torch import Tensor

from deltas_nets.network.correction import correction
from deltas_nets.network.known_depth import KnownDepth, as_points

__all__ = ["held"]

MOST = 200
"""Places that tell how far the rest of the map is off."""
FEWEST = 32
"""Of these: fewer say no more than when the map was made."""
DOUBTED = 3.0
"""Standard deviations of the difference beyond which what is measured is not believed, ..."""
AROUND, ALIKE, WITNESSES = 5, 0.05, 4
"""... unless so many others in a square so wide, in pixels, are so near to it in log depth."""


def held(found: KnownDepth, measured: KnownDepth) -> KnownDepth:
    """The map moved to what was measured, and where that is known the mean of both by precision.

    Args:
        found: ``(1, H, W)``.
        measured: ``(1, H, W)``, of the same unit; 0 where nothing was.
    """
    there = found.depth > 0
    known = there & (measured.depth > 0)
    if not known.any():
        return found
    log_depth = torch.where(there, found.depth, 1.0).log()
    said = measured._replace(depth=torch.where(known, measured.depth, 0.0))
    points = as_points(KnownDepth(*(part[None] for part in said)))
    moved = log_depth
    if points.weight.count_nonzero() >= FEWEST:
        process = correction(points, said.deviation[None].square(), log_depth[None], most=MOST)
        everywhere = torch.arange(log_depth.numel(), device=log_depth.device)[None]
        moved = log_depth + process.at(everywhere, log_depth[None]).view(log_depth.shape)
    log_said = torch.where(known, said.depth, 1.0).log()
    off = log_said - moved
    own, theirs = found.deviation.square(), said.deviation.square()
    near = off.square() < DOUBTED**2 * (own + theirs)
    # Where a surface was measured and not one place, the map is wrong and not the sensor.
    believed = known & (near | (_alike_around(log_said, known) >= WITNESSES))
    own = torch.where(near, own, off.square())
    share = torch.where(believed, own / (own + theirs).clamp_min(1e-12), 0.0)
    depth = torch.where(there, (moved + share * off).exp(), found.depth)
    return KnownDepth(depth, torch.where(believed, (share * theirs).sqrt(), found.deviation))


def _alike_around(log_depth: Tensor, known: Tensor) -> Tensor:
    """How many other known depths around each pixel are near to its own, ``(1, H, W)``."""
    apart = torch.where(known, log_depth, torch.inf)
    reach = AROUND // 2
    padded = F.pad(apart, (reach, reach, reach, reach), value=-torch.inf)
    height, width = log_depth.shape[-2:]
    count = torch.zeros_like(log_depth)
    for row, column in itertools.product(range(AROUND), repeat=2):
        there = padded[..., row : row + height, column : column + width]
        count += (there - apart).abs() < ALIKE  # infinite, or no number, where one is unknown
    return count - 1
