"""Random samples and the model that most data agree with.

Source: Fischler and Bolles, Random sample consensus (1981); Torr and Zisserman, MLESAC (2000), for
the cost, a squared distance that is cut off: of two models with equally many inliers the nearer
wins; Chum, Matas and Kittler, Locally optimized RANSAC (2003), for refinement of what leads;
Hartley and Zisserman, 2nd ed., section 4.7, for how many samples are enough.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from deltas_nets.config.checks import check_at_least, check_positive, check_seed

__all__ = ["Consensus", "ConsensusConfig", "find_consensus"]

ROUND = 128
"""Samples that are solved at once."""
PASSES = 4
"""Times that inliers are found anew and the model refined from them."""


@dataclass(frozen=True)
class ConsensusConfig:
    """How long to look and how near is near."""

    threshold: float = 3.0
    """Farthest that an inlier may be, pixels."""
    most: int = 2048
    """Samples at most; fewer where nearly all agree."""
    confidence: float = 0.9999
    """Probability with which one sample is free of outliers, after which no more are drawn."""
    seed: int = 0
    """Of the samples: the same data give the same model."""

    def __post_init__(self) -> None:
        check_positive(self, "threshold")
        check_at_least(1, self, "most")
        check_seed(self)
        if not 0 < self.confidence < 1:
            raise ValueError(f"confidence must be within (0, 1), got {self.confidence}")


class Consensus(NamedTuple):
    """What most data agree with.

    Attributes:
        model: ``(r, c)``.
        inliers: ``(N,)`` bool, nearer than the threshold.
        samples: how many were drawn.
    """

    model: Tensor
    inliers: Tensor
    samples: int


def find_consensus(
    count: int,
    sample_size: int,
    *,
    solve: Callable[[Tensor], Tensor],
    squared: Callable[[Tensor], Tensor],
    refine: Callable[[Tensor, Tensor], Tensor],
    config: ConsensusConfig,
) -> Consensus | None:
    """The model of the cheapest sample, refined from its inliers; None without any.

    Args:
        count: N, how many data there are.
        sample_size: how many define a model.
        solve: samples ``(S, sample_size)`` of indices to models ``(M, r, c)``; those that do not
            exist may be NaN.
        squared: models ``(M, r, c)`` to squared distances ``(M, N)`` of the data, square pixels.
        refine: a model ``(r, c)`` and its inliers ``(N,)`` to a better one.
        config: how long, how near.
    """
    if count < sample_size:
        return None
    generator = torch.Generator().manual_seed(config.seed)
    limit = config.threshold**2
    best: Tensor | None = None
    lowest, drawn, wanted = math.inf, 0, config.most
    while drawn < wanted:
        picked = torch.rand(ROUND, count, generator=generator).topk(sample_size, dim=1).indices
        drawn += ROUND
        models = solve(picked)
        models = models[models.isfinite().flatten(1).all(dim=1)]
        if len(models) == 0:
            continue
        costs = _costs(squared(models), limit)
        winner = int(costs.argmin())
        if float(costs[winner]) >= lowest:
            continue
        best, lowest = _polished(models[winner], float(costs[winner]), squared, refine, limit)
        share = float(_near(squared(best[None])[0], limit).double().mean())
        wanted = min(config.most, _enough(share, sample_size, config.confidence))
    if best is None:
        return None
    return Consensus(best, _near(squared(best[None])[0], limit), drawn)


def _polished(
    model: Tensor,
    cost: float,
    squared: Callable[[Tensor], Tensor],
    refine: Callable[[Tensor, Tensor], Tensor],
    limit: float,
) -> tuple[Tensor, float]:
    """The model refined from its inliers while that is cheaper."""
    for _ in range(PASSES):
        better = refine(model, _near(squared(model[None])[0], limit))
        new = float(_costs(squared(better[None]), limit)[0])
        if not new < cost:
            break
        model, cost = better, new
    return model, cost


def _near(squared: Tensor, limit: float) -> Tensor:
    return squared < limit  # False for NaN


def _costs(squared: Tensor, limit: float) -> Tensor:
    return squared.nan_to_num(nan=limit).clamp(max=limit).sum(dim=-1)


def _enough(share: float, sample_size: int, confidence: float) -> int:
    """Samples until one is free of outliers, of which there are ``1 - share``."""
    clean = share**sample_size
    if clean >= 1:
        return 1
    return math.ceil(math.log(1 - confidence) / math.log1p(-max(clean, 1e-12)))
