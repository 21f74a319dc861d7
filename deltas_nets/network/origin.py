"""A world whose origin is where the anchor stands.

A float32 knows places 5,000 km away to half a metre: cameras that far from the world's origin, as
in UTM coordinates, are moved there before they are rounded to the network's dtype.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom import PosedViews
from deltas_geom.cameras.poses import camera_centers


class Moved(NamedTuple):
    """Cameras in a world of the same axes and another origin.

    Attributes:
        views: ``(*B, V)``.
        origin: ``(*B, 1, 3)`` where that is in the world they came from, metres.
    """

    views: PosedViews
    origin: Tensor


def moved_to_anchor(views: PosedViews, dtype: torch.dtype) -> Moved:
    """The cameras in a world whose origin is the centre of view 0.

    Views keep their relative poses, also where rotations are orthogonal only to some digits: then
    the origin is a little beside the camera.

    Args:
        views: ``(*B, V)`` in any world.
        dtype: of the result; the origin is of the dtype of the poses where that is wider.
    """
    poses = views.cam_from_world
    poses = poses.to(torch.promote_types(poses.dtype, dtype))
    origin = camera_centers(poses[..., :1, :, :])
    rotation, translation = poses[..., :3, :3], poses[..., :3, 3:]
    nearer = rotation @ origin[..., None] + translation
    top = torch.cat([rotation, nearer], dim=-1)
    moved = torch.cat([top, poses[..., 3:, :]], dim=-2)
    return Moved(PosedViews(views.K, moved).to(dtype), origin)
