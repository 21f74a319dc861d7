"""Depth maps of other frames as the anchor would see them."""

import torch

from deltas_geom import PosedViews, project, rasterize_depth, unproject
from deltas_nets.network.known_depth import KnownDepth


def seen_from(
    maps: KnownDepth,
    views: PosedViews,
    anchor: PosedViews,
    *,
    image_size: tuple[int, int],
) -> KnownDepth:
    """Every pixel of each map as a point, drawn into the anchor's image; the nearest wins.

    Args:
        maps: ``(V, 1, H, W)``.
        views: their cameras, ``(V)``.
        anchor: ``(1)``.
        image_size: (height, width) of the anchor's image.

    Returns:
        ``(V, 1, *image_size)``.
    """
    height, width = maps.depth.shape[-2:]
    count = len(maps.depth)
    rows = torch.arange(height, device=maps.depth.device, dtype=views.K.dtype)
    columns = torch.arange(width, device=maps.depth.device, dtype=views.K.dtype)
    grid = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), dim=-1).reshape(1, -1, 2)
    depth = maps.depth.reshape(count, -1)
    points = unproject(views, grid.expand(count, -1, 2), depth.to(views.K))
    seen = project(anchor, points)  # (V, 1, N): one camera, the points of each map
    drawn = rasterize_depth(
        seen.pixels[:, 0].to(depth),
        seen.depth[:, 0].to(depth),
        image_size=image_size,
        mask=seen.in_front[:, 0] & (depth > 0),
        # As weights, so that the winner's comes along.
        weights=1 / maps.deviation.reshape(count, -1).clamp_min(1e-3),
    )
    filled = drawn.weight > 0
    deviation = torch.where(filled, 1 / torch.where(filled, drawn.weight, 1.0), 0.0)
    return KnownDepth(drawn.depth, deviation)
