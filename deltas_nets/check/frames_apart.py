"""Frames whose poses disagree with all others."""

import torch
from torch import Tensor

from deltas_geom.diagnosis.evidence import Evidence
from deltas_geom.diagnosis.trials import level
from deltas_nets.check.trying import ENOUGH

__all__ = ["MOSTLY", "views_apart"]

MOSTLY = 0.5
"""Of a pair's matches must fit where frames are judged one by one: own matches are that good, and a
quarter would often fit a frame that was moved."""
_TIMES = 5.0  # as much as the others' residuals is apart
_SHARE = 0.6  # of a view's pairs


def views_apart(
    evidence: Evidence, residual: Tensor, views: int, *, enough: float = ENOUGH
) -> list[int]:
    """Views whose matches with most others are off, while those of the others fit.

    The worst goes first, and its pairs with it, so that it does not spoil its neighbours.

    Args:
        evidence: P pairs.
        residual: ``(P)`` px.
        views: how many there are.
        enough: px, a residual of cameras that fit.

    Returns:
        Views; none if they are so many that nobody knows who is right.
    """
    left = torch.ones_like(residual, dtype=torch.bool)
    apart: list[int] = []
    while bool(left.any()):
        # Half of the pairs may be off: the others tell what is usual.
        usual = residual[left].sort().values[: -(-int(left.sum()) // 2)].mean()
        limit = max(enough, _TIMES * float(usual))
        worst, share, off = -1, 0.0, 0.0
        for view in range(views):
            own = residual[left & evidence.with_camera(view)]
            if not len(own):
                continue
            bad, mean = float((own > limit).double().mean()), float(own.mean())
            if bad >= _SHARE and (bad, mean) > (share, off):
                worst, share, off = view, bad, mean
        if worst < 0:
            break
        apart.append(worst)
        left &= ~evidence.with_camera(worst)
    agreeing = residual[left]
    if 3 * len(apart) > views or not len(agreeing) or level(agreeing) > enough:
        return []
    return sorted(apart)
