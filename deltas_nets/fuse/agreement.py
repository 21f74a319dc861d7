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
        unseen: ``(H, W)`` bool: no other map shows anything there.
        depth: ``(H, W)`` mean of the pixel's depth and of those that agree, by 1 / std^2.
    """

    agree: Tensor
    against: Tensor
    unseen: Tensor
    depth: Tensor


def agreement(view: DepthView, others: Sequence[DepthView], deviations: float = 1.0) -> Agreement:
    """Look at each point of a map in other maps.

    Args:
        view: the map.
        others: maps of frames that see much of the same.
        deviations: how far depths may differ and agree, in standard deviations of the difference.
    """
    known = view.depth > 0
    agree = torch.zeros_like(view.depth)
    against = torch.zeros_like(view.depth)
    weight = view.std.square().reciprocal()
    unseen = known.clone()
    total, moved = weight.clone(), torch.zeros_like(view.depth)
    points = view.points()
    variance = view.std.square()
    for other in others:
        other_from_view = other.cam_from_world @ view.world_from_cam
        proj = (other.K @ other_from_view[:3]).to(points)
        x, y, z = (proj[:, :3] @ points.reshape(-1, 3).T + proj[:, 3:]).view(3, *known.shape)
        per_depth = z.clamp_min(NEAREST).reciprocal()
        height, width = other.image_size
        column, row = (x * per_depth).add_(0.5).floor_(), (y * per_depth).add_(0.5).floor_()
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (z > NEAREST)
        pixel = row.clamp_(0, height - 1) * width + column.clamp_(0, width - 1)
        pixel = pixel.long().reshape(-1)
        depth = other.depth.reshape(-1)[pixel].view_as(z)
        theirs = other.std.reshape(-1)[pixel].view_as(z).square()
        seen = inside & known & (depth > 0)
        unseen &= ~seen
        farther = depth - z
        limit = deviations * (variance + theirs).sqrt()
        same = seen & (farther.abs() <= limit)
        agree += same
        against += seen & (farther > limit)
        their_weight = torch.where(same, theirs.reciprocal(), 0.0)
        total += their_weight
        moved += their_weight * farther
    depth = torch.where(known, view.depth + moved / total, 0.0)
    return Agreement(agree, against, unseen, depth)


def agreeing(
    view: DepthView, others: Sequence[DepthView], *, least: int = 1, deviations: float = 1.0
) -> DepthView:
    """The view less what fewer than ``least`` others confirm, or as many see through.

    Args:
        view: the map.
        others: maps of frames that see much of the same.
        least: maps that have to agree.
        deviations: as in :func:`agreement`.

    Returns:
        The view; depth that is left is averaged with those that agree.
    """
    found = agreement(view, others, deviations)
    kept = (found.agree >= least) & (found.agree > found.against)
    return view._replace(depth=torch.where(kept, found.depth, 0.0))
