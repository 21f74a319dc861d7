"""Robust losses of reprojection errors, and the second derivative that they give.

Source: Triggs et al., Bundle Adjustment: A Modern Synthesis (2000), section 4.3.
"""

from typing import Literal

import torch
from torch import Tensor

from deltas_geom.numerics.vectors import Symmetric3

Loss = Literal["squared", "huber", "cauchy"]


def robust_loss(loss: Loss, scale: float, squared: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """rho of squared distances s, px^2 (near 0 it is s), its influence rho', and 2 rho''."""
    if loss == "squared":
        return squared, squared.new_ones(()), squared.new_zeros(())
    # Beyond, where nothing is far, or everything, squares would leave the range of numbers.
    most = torch.finfo(squared.dtype).max ** 0.125
    scale = min(max(scale, 1 / most), most)
    ratio = squared / scale**2
    if loss == "cauchy":
        slope = 1 / (1 + ratio)
        return scale**2 * ratio.log1p(), slope, -2 * slope.square() / scale**2
    far, slope = ratio > 1, ratio.clamp(min=1).rsqrt()
    rho = torch.where(far, scale**2 * (2 / slope - 1), squared)
    return rho, slope, torch.where(far, slope**3 / -(scale**2), 0.0)


def second_derivative(
    normal: Symmetric3,
    proj: Tensor,
    place: tuple[Tensor, Tensor],
    offset: tuple[Tensor, Tensor],
    inverse: Tensor,
    influence: Tensor,
    bend: Tensor,
) -> Symmetric3:
    """Second derivative by points of half the sum of w^2 rho(e^2), e the reprojection errors.

    From J^T W^2 J with the weights w^2 rho' and, each ``(*B, V, N)``: x and y of the projected
    points and of the errors, 1 / depth, w^2 rho' and 2 w^2 rho''.
    """
    (x, y), (dx, dy) = place, offset
    p1, p2, p3 = proj[..., :3].unsqueeze(-2).unbind(dim=-3)  # (*B, V, 1, 3)
    along = dx * x + dy * y
    # J^T e of each view. A change of the point changes J by -(J p3^T + p3 J^T) / depth.
    slope = [(dx * p1[..., i] + dy * p2[..., i] - along * p3[..., i]) * inverse for i in range(3)]
    turn = [influence * inverse * p3[..., i] for i in range(3)]

    def entry(i: int, j: int) -> Tensor:
        bent = bend * slope[i] * slope[j] - turn[i] * slope[j] - turn[j] * slope[i]
        return bent.sum(dim=-2)

    places = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    return tuple(m + entry(*place) for m, place in zip(normal, places, strict=True))
