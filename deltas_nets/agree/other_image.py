"""Where the points of one image fall in another."""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom import PosedViews
from deltas_geom.cameras.poses import invert_pose

NEAREST = 1e-6
"""Depth up to which nothing is seen."""


class Motion(NamedTuple):
    """Takes pixels times depth of one image to those of another: ``turn @ (x, y, 1) z + shift``.

    Attributes:
        turn: ``(V, 3, 3)``.
        shift: ``(V, 3, 1)``.
    """

    turn: Tensor
    shift: Tensor


class Hit(NamedTuple):
    """Pixels on which points fall.

    Attributes:
        place: in the flat image; 0 where a point falls on none.
        inside: bool, where it falls on one.
    """

    place: Tensor
    inside: Tensor


def motion(here: PosedViews, there: PosedViews, *, like: Tensor) -> Motion:
    """From the images of some cameras to those of others.

    Args:
        here: ``(V)`` or ``(1)``.
        there: ``(V)`` or ``(1)``.
        like: a tensor of the dtype and device that are wanted.

    Source: Hartley and Zisserman, 2nd ed., section 9.2: x' ~ K' R K^-1 x + K' t / depth.
    """
    # In float64, and relative: with the world's origin kilometres away the sums would cancel.
    relative = there.cam_from_world @ invert_pose(here.cam_from_world)
    turn = there.K @ relative[..., :3, :3] @ here.K.inverse()
    return Motion(turn.to(like), (there.K @ relative[..., :3, 3:]).to(like))


def hit(x: Tensor, y: Tensor, z: Tensor, *, image_size: tuple[int, int]) -> Hit:
    """The pixel on which each point falls.

    Args:
        x: times depth, pixels, of any shape; the same of y.
        y: as x.
        z: depth.
        image_size: (height, width).

    Example:
        >>> x, y, z = torch.tensor([[4.0, -8.0, 0.0], [2.0, 2.0, 0.0], [2.0, 2.0, -2.0]])
        >>> hit(x, y, z, image_size=(3, 4))
        Hit(place=tensor([6, 0, 0]), inside=tensor([ True, False, False]))
    """
    height, width = image_size
    per_depth = 1 / z.clamp_min(NEAREST)
    column, row = (x * per_depth).add_(0.5).floor_(), (y * per_depth).add_(0.5).floor_()
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    inside &= z > NEAREST
    return Hit(torch.where(inside, row.mul_(width).add_(column), 0).long(), inside)
