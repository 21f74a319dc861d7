"""Why a point has no answer: the reasons, and which of them counts, for every solver."""

import torch
from torch import Tensor

from deltas_geom.numerics.arithmetic import surely_all
from deltas_geom.status import Status

REASONS = (
    Status.BEHIND_CAMERA,
    Status.AT_INFINITY,
    Status.NO_PARALLAX,
    Status.TOO_FEW_VIEWS,
    Status.NOT_FINITE_INPUT,
)
"""Of several the last one counts: without it the question before it has no answer."""


def judge(
    *, finite: Tensor, enough: Tensor, posed: Tensor, near: Tensor, in_front: Tensor
) -> Tensor:
    """Status ``(*B, N)`` int8; of several arguments that are False the first counts.

    Args:
        finite: ``(*B, N)`` bool: everything that is used is finite.
        enough: two views or more are used.
        posed: these stand apart, and beside the point, by more than rounding.
        near: their rays meet at a place that can be told from infinity, and represented.
        in_front: that is in front of all of them.
    """
    status = torch.zeros_like(in_front, dtype=torch.int8)
    passes = (in_front, near, posed, enough, finite)
    if all(map(surely_all, passes)):
        return status
    for passed, reason in zip(passes, REASONS, strict=True):
        status = torch.where(passed, status, status.new_full((), reason.value))
    return status


def ok(status: Tensor) -> Tensor:
    """Which points are valid ``(*B, N)``."""
    return status == Status.OK.value
