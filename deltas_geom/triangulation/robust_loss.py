"""Robust losses of reprojection errors.

Source: Triggs et al., Bundle Adjustment: A Modern Synthesis (2000), section 4.3.
"""

from typing import Literal

import torch
from torch import Tensor

Loss = Literal["squared", "huber", "cauchy"]


def robust_loss(loss: Loss, scale: float, squared: Tensor) -> tuple[Tensor, Tensor]:
    """rho of squared distances s, px^2 (near 0 it is s), and its influence rho'."""
    if loss == "squared":
        return squared, squared.new_ones(())
    ratio = squared / scale**2
    if loss == "cauchy":
        return scale**2 * ratio.log1p(), 1 / (1 + ratio)
    far, slope = ratio > 1, ratio.clamp(min=1).rsqrt()
    return torch.where(far, scale**2 * (2 / slope - 1), squared), slope
