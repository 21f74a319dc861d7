"""Which plane wins, where between the planes the surface is, and whether to believe it."""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import safe_divide

NEIGHBOURS = 2
"""Planes so near the best one say nothing about whether to believe it."""


class Winner(NamedTuple):
    """The best place of every pixel.

    Attributes:
        place: ``(H, W)`` in planes, with a fraction.
        margin: ``(H, W)`` by how much the best plane beats all that are no neighbours of it.
    """

    place: Tensor
    margin: Tensor


def winner(cost: Tensor) -> Winner:
    """The plane of least cost ``(S, H, W)``, refined by a parabola through its neighbours."""
    least, plane = cost.min(dim=0)
    inner = plane.clamp(1, len(cost) - 2)
    below, at, above = (cost.gather(0, (inner + step)[None])[0] for step in (-1, 0, 1))
    bend = below - 2 * at + above
    turn = safe_divide(0.5 * (below - above), bend, bend > 0).clamp(-0.5, 0.5)
    place = torch.where(inner == plane, plane + turn, plane.to(cost.dtype))
    planes = torch.arange(len(cost), device=cost.device)[:, None, None]
    near = (planes - plane).abs() <= NEIGHBOURS
    second = cost.masked_fill(near, torch.inf).amin(dim=0)
    return Winner(place, second - least)
