"""Which frames see what a frame sees, by their own depth maps."""

from collections.abc import Sequence

import torch
from torch import Tensor

from deltas_geom import PosedViews, project, unproject

MOST = 24
"""Neighbours that a map hears."""
LEAST = 0.3
"""Share of each map that the other must see."""
ACROSS = 8
"""Pixels along each side of a map that are asked for."""


def sample(depth: Tensor, view: PosedViews) -> Tensor:
    """World points ``(64, 3)`` of a map ``(1, h, w)``, evenly spread; NaN where it has no depth."""
    height, width = depth.shape[-2:]
    rows = torch.linspace(0, height - 1, ACROSS + 2)[1:-1].round().long()
    columns = torch.linspace(0, width - 1, ACROSS + 2)[1:-1].round().long()
    at = depth[0, rows[:, None], columns].reshape(1, -1)
    column, row = torch.meshgrid(columns, rows, indexing="xy")
    pixels = torch.stack([column, row], dim=-1).reshape(1, -1, 2).to(view.K)
    points = unproject(view, pixels, at.to(view.K))[0]
    # Of depth 0 the point would be the camera, which others may well see.
    return torch.where(at[0, :, None] > 0, points, torch.nan)


def neighbours(
    points: Tensor, views: PosedViews, image_sizes: Sequence[tuple[int, int]]
) -> list[list[int]]:
    """Of each frame those that share most with it, the best first.

    Args:
        points: ``(F, P, 3)`` of each frame's map, see `sample`.
        views: their cameras, ``(F)``.
        image_sizes: of their maps.

    Returns:
        F lists of positions, of at most `MOST` each.
    """
    sizes = torch.tensor(image_sizes)
    shares = []
    for seen in points:  # one frame at a time: a thousand of them are a million pairs
        found = project(views, seen)
        x, y = found.pixels.unbind(dim=-1)
        width, height = sizes[:, 1, None], sizes[:, 0, None]
        inside = (x >= -0.5) & (x < width - 0.5) & (y >= -0.5) & (y < height - 0.5)
        known = seen.isfinite().all(dim=-1)
        there = (known & inside & found.in_front).double().sum(dim=-1)
        shares.append(there / known.sum().clamp_min(1))
    share = torch.stack(shares)
    mutual = torch.minimum(share, share.T).fill_diagonal_(0)
    best, order = mutual.sort(dim=-1, descending=True, stable=True)
    enough = (best[:, :MOST] > LEAST).sum(dim=-1)
    return [places[:count].tolist() for places, count in zip(order, enough.tolist(), strict=True)]
