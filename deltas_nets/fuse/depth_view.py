"""A depth map with its camera: what everything here takes."""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.cameras.pixels import pixel_grid
from deltas_geom.cameras.poses import invert_pose
from deltas_geom.cameras.projection import pixel_rays

__all__ = ["DepthView", "nearest"]


class DepthView(NamedTuple):
    """Depth of one frame, its deviation and its colours.

    Attributes:
        depth: ``(H, W)`` float32 along z, 0 where there is none.
        std: ``(H, W)`` float32 standard deviation of the depth, in the same unit, positive.
        colors: ``(H, W, 3)`` uint8.
        K: ``(3, 3)`` float64 of this image, pixel centres at integers.
        cam_from_world: ``(4, 4)`` float64.
    """

    depth: Tensor
    std: Tensor
    colors: Tensor
    K: Tensor
    cam_from_world: Tensor

    @property
    def image_size(self) -> tuple[int, int]:
        """(height, width)."""
        return self.depth.shape[0], self.depth.shape[1]

    @property
    def world_from_cam(self) -> Tensor:
        """``(4, 4)`` float64."""
        return invert_pose(self.cam_from_world)

    def only(self, mask: Tensor) -> "DepthView":
        """The view less the depth where a mask ``(H, W)`` is False."""
        return self._replace(depth=torch.where(mask, self.depth, 0.0))

    def rays(self) -> Tensor:
        """``(H, W, 3)`` float32 camera points at depth 1."""
        pixels = pixel_grid(self.image_size, dtype=torch.float64).to(self.K)
        return pixel_rays(self.K, pixels).reshape(*self.image_size, 3).float()

    def points(self) -> Tensor:
        """``(H, W, 3)`` float32 in the camera's axes; zero where there is no depth."""
        return self.rays() * self.depth[..., None]

    def to(self, device: str | torch.device) -> "DepthView":
        """The view on a device."""
        return DepthView(*(tensor.to(device) for tensor in self))


def nearest(image: Tensor, pixels: Tensor) -> Tensor:
    """An image ``(H, W, ...)`` at the nearest of its pixels ``(*B, 2)``; 0 beyond it."""
    height, width = image.shape[:2]
    column, row = (pixels + 0.5).floor().unbind(dim=-1)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    column, row = column.clamp(0, width - 1).long(), row.clamp(0, height - 1).long()
    found = image[row, column]
    inside = inside.view(*inside.shape, *(1,) * (image.ndim - 2))
    return torch.where(inside, found, torch.zeros_like(found))
