"""Which frames see what a frame sees, by their own depth maps."""

from collections.abc import Sequence

import torch
from torch import Tensor

from deltas_geom import PosedViews, project, unproject
from deltas_geom.cameras.poses import camera_centers

MOST = 24
"""Neighbours that a map hears."""
LEAST = 0.3
"""Share of each map that the other must see."""
ACROSS = 8
"""Pixels along each side of a map that are asked for."""
APART = 0.005
"""Part of the depth from which on a camera stands in another place. Maps from one place err alike,
so that those of a camera that was held still outvoted all that saw more."""


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
    points: Tensor,
    views: PosedViews,
    image_sizes: Sequence[tuple[int, int]],
    *,
    apart: float = 0.0,
) -> list[list[int]]:
    """Of each frame those that share most with it, the best first.

    Args:
        points: ``(F, P, 3)`` of each frame's map, see `sample`.
        views: their cameras, ``(F)``.
        image_sizes: of their maps.
        apart: part of the depth by which cameras stand apart from the frame's and each other's.

    Returns:
        F lists of positions, of at most `MOST` each.
    """
    sizes = torch.tensor(image_sizes)
    centres = camera_centers(views.cam_from_world)
    shares, near = [], []
    for seen, centre in zip(points, centres, strict=True):  # not all at once: a million pairs
        found = project(views, seen)
        x, y = found.pixels.unbind(dim=-1)
        width, height = sizes[:, 1, None], sizes[:, 0, None]
        inside = (x >= -0.5) & (x < width - 0.5) & (y >= -0.5) & (y < height - 0.5)
        known = seen.isfinite().all(dim=-1)
        there = (known & inside & found.in_front).double().sum(dim=-1)
        shares.append(there / known.sum().clamp_min(1))
        depth = (seen[known] - centre).norm(dim=-1).nanmedian()
        near.append((centres - centre).norm(dim=-1) < apart * depth)
    share = torch.stack(shares)
    mutual = torch.minimum(share, share.T).fill_diagonal_(0)
    best, order = mutual.sort(dim=-1, descending=True, stable=True)
    enough = (best > LEAST).sum(dim=-1)
    alike = torch.stack(near)
    return [
        _apart(own, places[:count].tolist(), alike)
        for own, (places, count) in enumerate(zip(order, enough.tolist(), strict=True))
    ]


def _apart(own: int, places: Sequence[int], alike: Tensor) -> list[int]:
    """The first `MOST` of some frames that stand neither where the own does nor where another."""
    chosen: list[int] = []
    repeats = alike[own].clone()
    for place in places:
        if not repeats[place]:
            chosen.append(place)
            repeats |= alike[place]
        if len(chosen) == MOST:
            break
    return chosen
