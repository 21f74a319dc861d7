"""Candidates for a point from pairs of its views."""

import torch
from torch import Tensor


def pairs_of(usable: Tensor, most: int) -> tuple[Tensor, Tensor, Tensor]:
    """Pairs of usable views of each point: first, second and whether it exists, ``(*B, C, N)``.

    Views on a circle: pairs half of it apart come first, neighbours last, each pair once.
    """
    count = min(most, usable.shape[-2] * (usable.shape[-2] - 1) // 2)
    order = (~usable).to(torch.int8).argsort(dim=-2, stable=True)  # usable views first
    around = usable.sum(dim=-2, keepdim=True).clamp(min=1)
    pair = torch.arange(count, device=usable.device)[:, None]
    # More views than pairs: start at views all over the circle rather than at the first.
    first = torch.where(around > count, pair * around // max(1, count), pair % around)
    apart = (around - 1) // 2 - pair // around
    # Of an even number of views, the diameters are the half round that is left at the end.
    apart = torch.where(apart > 0, apart, around // 2)
    second = (first + apart) % around
    exist = pair < around * (around - 1) // 2
    return order.gather(-2, first), order.gather(-2, second), exist


def points_of_pairs(
    lines: Tensor, first: Tensor, second: Tensor, exist: Tensor
) -> tuple[Tensor, Tensor]:
    """Points ``(*B, 3, C, N)`` of pairs of views, and whether they exist ``(*B, C, N)``.

    Where the rays are closest to each other, the point between them at which both views are off
    by about as many pixels. Lines are ``(*B, 6, V, N)``: centres of the cameras, then directions of
    rays of depth 1; 0 if there is no centre. All else is ``(*B, C, N)``.
    """
    views = torch.cat([first, second], dim=-2).unsqueeze(-3)
    # Not take_along_dim: for the sake of negative ones it divides each index.
    of_both = lines.gather(-2, views.expand(*lines.shape[:-2], -1, -1))
    (start, one), (end, other) = (
        half.tensor_split(2, dim=-3) for half in of_both.tensor_split(2, dim=-2)
    )

    def dot(a: Tensor, b: Tensor) -> Tensor:
        return (a * b).sum(dim=-3)

    apart = end - start
    a, b, c = dot(one, one), dot(one, other), dot(other, other)
    p, q = dot(apart, one), dot(apart, other)
    sine = a * c - b * b
    crossing = sine > 0
    sine = torch.where(crossing, sine, 1.0)
    near, far = (c * p - b * q) / sine, (b * p - a * q) / sine
    # An offset at depth z moves the pixel by 1 / z: the nearer view has more to say.
    share = near.square() / (near.square() + far.square())
    on_one, on_other = start + near.unsqueeze(-3) * one, end + far.unsqueeze(-3) * other
    points = on_one + share.unsqueeze(-3) * (on_other - on_one)
    return points, exist & crossing
