"""Gaps are filled from pixels that can be believed, and edges of the image stop what flows."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

ROUNDS = 3
"""Of rows and columns in turn."""


class Smoothing(NamedTuple):
    """How far values reach.

    Attributes:
        strength: the square of the reach in pixels, about, where the image has no contrast.
        contrast: difference of grey values that divides the tie between neighbours by e.
    """

    strength: float
    contrast: float


def filled(values: Tensor, weight: Tensor, guide: Tensor, smoothing: Smoothing) -> Tensor:
    """Weighted least squares along rows and columns in turn, with less and less smoothing.

    Args:
        values: ``(H, W)``; where the weight is 0 they do not count.
        weight: ``(H, W)`` not negative.
        guide: ``(H, W)`` grey values in [0, 1].
        smoothing: how far values reach.

    Returns:
        ``(H, W)``; their mean where no value reaches, and 0 if nothing has a weight.

    Source: Min et al., Fast global image smoothing based on weighted least squares (2014), section
    III; values and weights are smoothed alike, as theirs in section IV.
    """
    both = torch.stack([torch.where(weight > 0, values, 0.0) * weight, weight])
    for number in range(ROUNDS):
        share = smoothing.strength * 1.5 * 4.0 ** (ROUNDS - 1 - number) / (4.0**ROUNDS - 1)
        both = _along_rows(both, guide, share, smoothing.contrast)
        both = _along_rows(both.mT, guide.mT, share, smoothing.contrast).mT
    total = both[0].sum() / both[1].sum().clamp_min(1e-12)
    known = both[1] > 1e-12 * both[1].amax()
    return torch.where(known, both[0] / torch.where(known, both[1], 1.0), total)


def _along_rows(values: Tensor, guide: Tensor, strength: float, contrast: float) -> Tensor:
    """Each row ``(C, H, W)`` by itself: a tridiagonal system, solved from end to end and back."""
    tied = strength * torch.exp(-guide.diff(dim=-1).abs() / contrast)
    before = F.pad(tied, (1, 0))
    after = F.pad(tied, (0, 1))
    diagonal = 1 + before + after
    # Lines along the first dim: every step reads and writes one piece of memory.
    low, high, middle = (-part.mT.contiguous() for part in (before, after, -diagonal))
    right = values.permute(2, 0, 1).contiguous()
    ahead, found = torch.empty_like(high), torch.empty_like(right)
    ahead[0], found[0] = high[0] / middle[0], right[0] / middle[0]
    for column in range(1, len(right)):
        pivot = middle[column] - low[column] * ahead[column - 1]
        ahead[column] = high[column] / pivot
        found[column] = (right[column] - low[column] * found[column - 1]) / pivot
    for column in range(len(right) - 2, -1, -1):
        found[column] -= ahead[column] * found[column + 1]
    return found.permute(1, 2, 0)
