"""Hypotheses about the cameras of a whole capture, and what they make of its matches."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from torch import Tensor

from deltas_geom import PosedViews
from deltas_geom.diagnosis.evidence import Evidence, residuals
from deltas_geom.diagnosis.trials import level
from deltas_nets.captures.capture import Capture
from deltas_nets.check.finding import Finding, Mend
from deltas_nets.check.matched import Matched

__all__ = [
    "ENOUGH",
    "MENDED",
    "Case",
    "Suspect",
    "Tried",
    "common",
    "rounded",
    "searched",
    "tried",
]

ENOUGH = 2.0
"""px at the size that frames are looked at (about 400 wide): cameras that fit are below."""
MENDED = 1.3
"""px at that size that a cure may leave: clean captures leave 0.15 to 0.9. What leaves more made
residuals smaller by accident, however large they were."""
COMMON = tuple(1 / n for n in (1.1, 1.2, 1.25, 1.5, 2, 3, 4))
COMMON += (1.1, 1.2, 1.25, 4 / 3, 1.5, 2.0, 3.0, 4.0)
"""Factors that people resize images by."""
_LEFT = 0.5  # of the residuals, at most, where a hypothesis explains them
_LEAST_GAIN = 0.3  # px
_NEXT = 0.03  # relative, of a factor next to another


class Tried(NamedTuple):
    """A hypothesis, on the pairs of frames that it can be tried on.

    Attributes:
        given: px, as the capture has it.
        after: px, with the cure.
    """

    given: float
    after: float

    @property
    def explains(self) -> bool:
        """Whether so little is left that it is no accident."""
        gain = self.given - self.after
        return gain > _LEAST_GAIN and self.after <= min(_LEFT * self.given, MENDED)

    @property
    def in_words(self) -> str:
        """The figures."""
        return f"matches are {self.given:.3g} px off as given, {self.after:.2g} px with the cure"


class Suspect(NamedTuple):
    """A hypothesis, before it is known whether another explains more.

    Attributes:
        tried: what it makes of residuals.
        finding: what is said if it is the one.
    """

    tried: Tried
    finding: Finding


def tried(evidence: Evidence, given: Tensor, views: PosedViews) -> Tried:
    """Try cameras on pairs whose residuals ``(P)`` are known as given."""
    return Tried(level(given), level(residuals(evidence, *views)))


class Case(NamedTuple):
    """A capture whose cameras are judged by its matches.

    Attributes:
        capture: as it was read.
        matched: its matches.
        evidence: the same, of P pairs.
        given: ``(P)`` px, residuals as the capture has it.
    """

    capture: Capture
    matched: Matched
    evidence: Evidence
    given: Tensor

    def mended(self, mend: Mend) -> Tried:
        """What a cure makes of residuals, by the cameras that it really writes."""
        return tried(self.evidence, self.given, self.matched.views(mend(self.capture).frames))


def searched(cost: Callable[[float], float]) -> float:
    """The factor of least cost, 0.2 to 5, to 0.05 %; a grid first, as costs have many valleys."""
    grid = np.exp(np.linspace(np.log(0.2), np.log(5.0), 53))
    costs = [cost(float(factor)) for factor in grid]
    best = int(np.argmin(costs))
    center, width, least = float(grid[best]), float(np.log(grid[1] / grid[0])), costs[best]
    while width > 5e-4:
        width *= 0.5
        for factor in (center * np.exp(-width), center * np.exp(width)):
            found = cost(float(factor))
            if found < least:
                center, least = float(factor), found
    return center


def rounded(factor: float, cost: Callable[[float], float]) -> float:
    """A factor that people resize by, where that is next to the best and about as good."""
    # Of factors that are a few parts of a hundred apart, as 0.8 and 0.83, residuals know which.
    near = [common for common in COMMON if abs(np.log(common / factor)) < _NEXT]
    best = min(near, key=cost, default=factor)
    return best if cost(best) <= 1.15 * cost(factor) + 0.05 else factor


def common(factor: float, *, within: float) -> float:
    """The nearest factor that people resize by, if it is within a part of this one; else this.

    Example:
        >>> common(2.05, within=0.04), common(2.5, within=0.04)
        (2.0, 2.5)
    """
    near = min(COMMON, key=lambda common: abs(np.log(common / factor)))
    return near if abs(np.log(near / factor)) < within else factor
