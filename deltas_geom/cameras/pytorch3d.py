"""PyTorch3D's cameras as ours."""

import torch
from torch import Tensor

from deltas_geom.cameras.pixels import intrinsics
from deltas_geom.checks import check_batch, check_image_size
from deltas_geom.numerics.arithmetic import promoted, without_autocast


@without_autocast
def from_pytorch3d(
    R: Tensor, T: Tensor, focal_length: Tensor, principal_point: Tensor, image_size: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """K ``(*B, V, 3, 3)`` and ``cam_from_world`` of :meth:`PosedViews.from_pytorch3d`."""
    check_image_size(image_size)
    batch = check_batch(
        R=(R, "V 3 3"),
        T=(T, "V 3"),
        focal_length=(focal_length, "V 2"),
        principal_point=(principal_point, "V 2"),
    )
    given = promoted(R, T, focal_length, principal_point)
    R, T, focal, principal = (
        each.expand(*batch, *each.shape[dims:])
        for each, dims in zip(given, (-3, -2, -2, -2), strict=True)
    )
    height, width = image_size
    shorter = min(image_size) / 2  # px of a unit of NDC
    fx, fy = (shorter * focal).unbind(dim=-1)
    left, up = (shorter * principal).unbind(dim=-1)
    # Half of the width is the middle counted from the corner; our centres are at integers.
    cx, cy = (width - 1) / 2 - left, (height - 1) / 2 - up
    x, y, z = torch.cat([R.mT, T.unsqueeze(-1)], dim=-1).unbind(dim=-2)
    last = torch.eye(4, device=z.device, dtype=z.dtype)[3].expand_as(z)
    return intrinsics(fx, fy, cx, cy), torch.stack([-x, -y, z, last], dim=-2)
