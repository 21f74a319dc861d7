"""How many places a mean is over, when one process and one pass see only a part of the batch.

A loss term is a sum over the places that count, such as keypoints with a known depth, divided
by their number. Parts of a batch hold different numbers of them, so the mean of the parts'
means is not the mean over the batch. Here every part divides by its share of the number in the
whole batch; then the mean over parts is exact, and so is its gradient.
"""

from collections.abc import Callable

import torch
from torch import Tensor


class Divisors:
    """What sums are divided by where one pass of one process sees the whole batch."""

    def divisor(self, count: Tensor) -> Tensor:
        """What to divide a sum over ``count`` places by; 1 where the batch has none.

        Args:
            count: int64 scalar, places in this part of the batch.
        """
        return count.clamp_min(1)


WHOLE = Divisors()


class DivisorsOverProcesses(Divisors):
    """Other processes hold parts of the batch: each count is summed when it is needed.

    Args:
        add_up: sum of an int64 scalar over all processes; each of them calls it for each term.
        parts: number of processes.
    """

    def __init__(self, add_up: Callable[[Tensor], Tensor], parts: int) -> None:
        self.add_up = add_up
        self.parts = parts

    def divisor(self, count: Tensor) -> Tensor:
        """The processes' total, divided by their number."""
        return self.add_up(count).clamp_min(1) / self.parts


class DivisorsToCome(Divisors):
    """Remembers the counts of a first pass, whose means are of no use."""

    def __init__(self) -> None:
        self.seen: list[Tensor] = []

    def divisor(self, count: Tensor) -> Tensor:
        """The count itself, remembered."""
        self.seen.append(count)
        return count.clamp_min(1)

    def all(self) -> Tensor:
        """``(terms,)`` int64 in the order in which the losses asked."""
        return torch.stack(self.seen)


class KnownDivisors(Divisors):
    """All parts of the batch were counted before.

    Args:
        totals: ``(terms,)`` int64 over all parts, in the order in which the losses ask.
        parts: passes times processes.
    """

    def __init__(self, totals: Tensor, parts: int) -> None:
        self.divisors = iter((totals.clamp_min(1) / parts).unbind())

    def divisor(self, count: Tensor) -> Tensor:
        """The next term's total, divided by the number of parts."""
        return next(self.divisors)
