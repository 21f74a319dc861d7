"""What other maps say of a map's depth: they see the same surface there, or they see through it."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from deltas_nets.agree.other_image import hit
from deltas_nets.fuse.depth_view import DepthView

__all__ = ["Agreement", "agreeing", "agreement"]


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
        place, inside = hit(x, y, z, image_size=other.image_size)
        depth, theirs = other.depth.reshape(-1)[place], other.std.reshape(-1)[place]
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
