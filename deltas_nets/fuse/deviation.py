"""How far depth may be off, from what the files say."""

import math

import torch
from torch import Tensor

__all__ = ["std_of_confidence", "std_of_sensor"]

TOLERANCE = 0.05
"""Relative error whose probability a confidence is, as `DepthPrediction.confidence` has it."""
STEPS = 255
UNSTATED = 0.05
"""Relative deviation of maps that state none: all weigh alike then, but for their distance."""
OF_SENSORS = 0.02
"""Relative deviation of sensor depth: structured light and time of flight at a few metres."""


def std_of_confidence(depth: Tensor, confidence: Tensor | None) -> Tensor:
    """The standard deviation of depth, from the probability that it is right within 5 %.

    A Laplace distribution of scale s (relative) is within t of its middle with probability
    1 - exp(-t / s), and deviates by sqrt(2) s. A byte tells s from 0.008 to 25 only.

    Args:
        depth: ``(H, W)``, 0 where there is none.
        confidence: ``(H, W)`` uint8, 255 times the probability; None where none is stated.

    Returns:
        ``(H, W)`` in the depth's unit, positive.
    """
    somewhere = torch.where(depth > 0, depth, 1.0)
    if confidence is None:
        return UNSTATED * somewhere
    probability = confidence.to(depth).clamp(0.5, STEPS - 0.5) / STEPS
    scale = -TOLERANCE / torch.log1p(-probability)
    return math.sqrt(2) * scale * somewhere


def std_of_sensor(depth: Tensor) -> Tensor:
    """The standard deviation ``(H, W)`` of what a sensor measured, positive."""
    return OF_SENSORS * torch.where(depth > 0, depth, 1.0)
