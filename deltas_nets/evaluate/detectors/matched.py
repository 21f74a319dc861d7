"""Matches by descriptors alone: each is the other's nearest."""

import torch
from torch import Tensor

from deltas_geom.checks import check_shapes

__all__ = ["mutual_nearest"]


def mutual_nearest(first: Tensor, second: Tensor) -> Tensor:
    """Pairs of descriptors that are nearest to each other.

    Args:
        first: ``(N, D)``.
        second: ``(M, D)``.

    Returns:
        ``(P, 2)`` indices; none where D is 0, as nothing is described. Of equal distances the first
        counts.

    Raises:
        ShapeError: a trailing shape differs.

    Example:
        >>> first = torch.tensor([[0.0], [5.0]])
        >>> mutual_nearest(first, torch.tensor([[4.0], [0.5], [9.0]])).tolist()
        [[0, 1], [1, 0]]
    """
    check_shapes(first=(first, "N D"), second=(second, "M D"))
    if 0 in first.shape or 0 in second.shape:
        return torch.zeros(0, 2, dtype=torch.long)
    distances = torch.cdist(first, second, compute_mode="donot_use_mm_for_euclid_dist")
    forth, back = distances.argmin(dim=1), distances.argmin(dim=0)
    index = torch.arange(len(first))
    mutual = back[forth] == index
    return torch.stack([index[mutual], forth[mutual]], dim=-1)
