"""Lindstrom's correction: two pixels, moved as little as possible, whose rays meet.

Source: Lindstrom, Triangulation Made Easy (CVPR 2010), algorithm niter2.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import safe_sqrt
from deltas_geom.numerics.sums import product


def correction(fundamental: Tensor, xy: Tensor, safe: Callable[[Tensor], Tensor]) -> Tensor:
    """What to take from pixels ``(*B, 2, 2, N)`` so that the rays of each pair meet, px."""
    x1, x2 = xy.unbind(dim=-3)
    # Normals of the epipolar lines, and the epipolar error.
    a1, b1, last = (product(fundamental[..., :2], x2) + fundamental[..., 2:]).unbind(dim=-2)
    back = fundamental[..., :2].mT
    a2, b2 = (product(back[..., :2], x1) + back[..., 2:]).unbind(dim=-2)
    error = a1 * x1[..., 0, :] + b1 * x1[..., 1, :] + last
    # In units of the longer normal all that follows is in pixels, near the epipoles too.
    share = 1 / safe(torch.stack([a1, b1, a2, b2]).detach().abs().amax(dim=0))
    a1, b1, a2, b2, error = (value * share for value in (a1, b1, a2, b2, error))
    f00, f01, f10, f11 = (fundamental[..., i, j, None] * share for i in (0, 1) for j in (0, 1))

    # The pair that moves by k times its normals meets where error - 2 half k + curve k^2 = 0.
    da1, db1 = f00 * a2 + f01 * b2, f10 * a2 + f11 * b2
    da2, db2 = f00 * a1 + f10 * b1, f01 * a1 + f11 * b1
    curve = a1 * da1 + b1 * db1
    squared1, squared2 = a1 * a1 + b1 * b1, a2 * a2 + b2 * b2
    half = (squared1 + squared2) / 2
    under = half * half - curve * error
    real = under > 0
    root = safe_sqrt(torch.where(real, under, 1.0))
    # Gross errors near the epipoles have no such pair: there one pixel moves to the other's line.
    k = error / safe(torch.where(real, half + root, torch.maximum(squared1, squared2)))
    k1 = torch.where(real | (squared1 >= squared2), k, 0.0)
    k2 = torch.where(real | (squared1 < squared2), k, 0.0)

    # The lines through that pair correspond: the given pixels' nearest on them meet exactly.
    def moved(k: Tensor, a: Tensor, b: Tensor, new_a: Tensor, new_b: Tensor) -> Tensor:
        share = k * (a * new_a + b * new_b) / safe(new_a * new_a + new_b * new_b)
        return torch.stack([share * new_a, share * new_b], dim=-2)

    first = moved(k1, a1, b1, a1 - k2 * da1, b1 - k2 * db1)
    second = moved(k2, a2, b2, a2 - k1 * da2, b2 - k1 * db2)
    return torch.stack([first, second], dim=-3)
