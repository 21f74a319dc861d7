"""The learning rate from step to step."""

import math
from typing import Literal

Schedule = Literal["cosine", "constant"]


def rate_factor(step: int, steps: int, *, warmup: int, schedule: Schedule = "cosine") -> float:
    """The share of the peak rate that a step gets: a linear warm-up, then what the schedule says.

    Args:
        step: counted from 0.
        steps: of the whole schedule.
        warmup: steps until the peak; a tenth of all at most.
        schedule: half a cosine down to a hundredth, or the peak to the end.
    """
    warm = min(1.0, (step + 1) / max(1, min(warmup, steps // 10)))
    if schedule == "constant":
        return warm
    return warm * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * step / steps)))
