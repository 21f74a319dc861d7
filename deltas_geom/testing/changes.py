"""What must change an answer in a known way, or not at all: world, crop, resize."""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import to_homogeneous
from deltas_geom.cameras.pixels import crop_intrinsics, resize_intrinsics
from deltas_geom.cameras.poses import invert_pose
from deltas_geom.cameras.views import PosedViews
from deltas_geom.testing.scenes import IMAGE_SIZE, rigid


class World(NamedTuple):
    """Another frame and unit for the same world: points X become scale (R X + t).

    Attributes:
        new_from_world: ``(4, 4)`` rigid.
        scale: new units in a metre.
    """

    new_from_world: Tensor
    scale: float

    def points(self, points: Tensor) -> Tensor:
        """Points ``(N, 3)`` in the new world."""
        rotation, translation = self.new_from_world[:3, :3], self.new_from_world[:3, 3]
        return self.scale * (points @ rotation.mT + translation)

    def views(self, views: PosedViews) -> PosedViews:
        """The same cameras in the new world."""
        pose = views.cam_from_world @ invert_pose(self.new_from_world)
        unit = torch.tensor([self.scale] * 3 + [1.0], dtype=pose.dtype)
        moved = torch.cat([pose[..., :3], pose[..., 3:] * unit[:, None]], dim=-1)
        return views._replace(cam_from_world=moved)


ELSEWHERE = World(
    rigid(torch.tensor([0.5, -1.0, 2.0]).double(), torch.tensor([10.0, -5.0, 3.0]).double()), 3.0
)
"""11 m away, turned, in units of a third of a metre."""


def cut(views: PosedViews, *, new_size: tuple[int, int]) -> Tensor:
    """How pixels change, ``(V, 3, 3)``: each view cropped elsewhere, all resized alike."""
    identity = torch.eye(3, dtype=views.K.dtype)
    cropped = [
        crop_intrinsics(identity, left=3.0 + 7 * view, top=11.0 - 5 * view)
        for view in range(views.num_views)
    ]
    return resize_intrinsics(torch.stack(cropped), old_size=IMAGE_SIZE, new_size=new_size)


def transformed(change: Tensor, pixels: Tensor) -> Tensor:
    """Pixels ``(*B, N, 2)`` after a change ``(*B, 3, 3)`` of the image."""
    return (to_homogeneous(pixels) @ change.mT)[..., :2]
