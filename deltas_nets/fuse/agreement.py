"""What other maps say of a map's depth: they see the same surface there, or they see through it."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from deltas_nets.fuse.depth_view import DepthView

__all__ = ["Agreement", "agreeing", "agreement"]

NEAREST = 1e-6


class Agreement(NamedTuple):
    """Of each pixel.

    Attributes:
        agree: ``(H, W)`` how many maps see a surface where the pixel's point is.
        against: ``(H, W)`` how many see through it: what they show is farther away. Maps that show
            something nearer say nothing, it may hide the point.
    """

    agree: Tensor
    against: Tensor


def agreement(view: DepthView, others: Sequence[DepthView], deviations: float = 0.5) -> Agreement:
    """Look at each point of a map in other maps.

    Args:
        view: the map.
        others: maps of frames that see much of the same.
        deviations: how far depths may differ and agree, in standard deviations of the difference.
    """
    known = view.depth > 0
    agree, against = torch.zeros_like(view.depth), torch.zeros_like(view.depth)
    points, variance = view.points().reshape(-1, 3).T, view.std.square()
    for other in others:
        # Relative poses first: with the world's origin kilometres away the sums would cancel.
        proj = (other.K @ (other.cam_from_world @ view.world_from_cam)[:3]).to(points)
        x, y, z = (proj[:, :3] @ points + proj[:, 3:]).view(3, *known.shape)
        per_depth = z.clamp_min(NEAREST).reciprocal()
        height, width = other.image_size
        column, row = (x * per_depth).add_(0.5).floor_(), (y * per_depth).add_(0.5).floor_()
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (z > NEAREST)
        column, row = column.clamp_(0, width - 1).long(), row.clamp_(0, height - 1).long()
        pixel = row.mul_(width).add_(column).reshape(-1)
        depth = other.depth.reshape(-1)[pixel].view_as(z)
        theirs = other.std.reshape(-1)[pixel].view_as(z)
        limit = deviations * (variance + theirs.square()).sqrt()
        seen, farther = inside & known & (depth > 0), depth - z
        agree += seen & (farther.abs() <= limit)
        against += seen & (farther > limit)
    return Agreement(agree, against)


def agreeing(
    view: DepthView, others: Sequence[DepthView], *, least: int = 1, deviations: float = 0.5
) -> DepthView:
    """The view less what fewer than ``least`` others confirm, or as many see through.

    Args:
        view: the map.
        others: maps of frames that see much of the same.
        least: maps that have to agree.
        deviations: as in :func:`agreement`.
    """
    found = agreement(view, others, deviations)
    return view.only((found.agree >= least) & (found.agree > found.against))
