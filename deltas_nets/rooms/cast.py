"""Exact ray casting: which solid a camera sees at each pixel, and how far away.

Rays have z = 1 in the camera, so the ray parameter *is* the depth. In the axes of a solid,
scaled so that it becomes a unit cube, sphere or cylinder, a ray is affine in the pixel.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_nets.rooms.furniture import BOX, CYLINDER, ELLIPSOID
from deltas_nets.rooms.scene import Solids

NEAR = 0.05  # m, nothing is seen nearer than this
# The twelve edges of a box, as pairs of corners whose numbers differ in one bit.
_EDGES = [(i, i | bit) for bit in (1, 2, 4) for i in range(8) if not i & bit]


class Hits(NamedTuple):
    """What each pixel sees."""

    depth: Tensor
    """``(H, W)`` metres along z at the pixel centre."""
    solid: Tensor
    """``(H, W)`` int64; 0 is the room."""


def pixel_rays(K: Tensor, *, image_size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """The rays K^-1 (x, y, 1) of all pixel centres; K without skew.

    Args:
        K: ``(3, 3)``.
        image_size: height, width.

    Returns:
        Their x ``(W,)``, which depends on the column only, and their y ``(H,)``.
    """
    height, width = image_size
    columns = torch.arange(width, dtype=K.dtype, device=K.device)
    rows = torch.arange(height, dtype=K.dtype, device=K.device)
    return (columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1]


def cast_rays(
    solids: Solids,
    K: Tensor,
    cam_from_world: Tensor,
    *,
    image_size: tuple[int, int],
    beyond: Tensor | float = NEAR,
) -> Hits:
    """Nearest solid along the ray of every pixel; solid 0 is seen from inside.

    Each solid is cast only over its bounding rectangle in the image.

    Args:
        solids: N of them.
        K: ``(3, 3)``, without skew.
        image_size: height, width.
        cam_from_world: ``(4, 4)``; the camera stands inside solid 0 and outside the others, or
            is the image of such a camera in a mirror.
        beyond: metres along z, a number or ``(H, W)``: nothing nearer is seen. For a mirrored
            camera the mirror's own depth, since its rays begin there.
    """
    nearest = torch.as_tensor(beyond, dtype=K.dtype, device=K.device).expand(image_size)
    ray_x, ray_y = pixel_rays(K, image_size=image_size)
    turn, shift = cam_from_world[:3, :3], cam_from_world[:3, 3]
    unit_from_world = solids.local_from_world / solids.half_size[..., None]
    camera = -turn.mT @ shift
    origins = (unit_from_world @ (camera - solids.centre)[..., None])[..., 0]
    directions = unit_from_world @ turn.mT  # (N, 3, 3); times (x, y, 1) of a ray
    rectangles = _bounding_rectangles(solids, K, cam_from_world, image_size=image_size).tolist()

    depth = torch.zeros(image_size, dtype=K.dtype, device=K.device)
    index = torch.zeros(image_size, dtype=torch.int64, device=K.device)
    for n, shape in enumerate(solids.shape.tolist()):
        left, top, right, bottom = rectangles[n] if n else (0, 0, *image_size[::-1])
        if left >= right or top >= bottom:
            continue
        d = directions[n]
        along_x = d[:, 0, None] * ray_x[left:right]
        along_y = d[:, 1, None] * ray_y[top:bottom] + d[:, 2, None]
        direction = along_x[:, None, :] + along_y[:, :, None]  # (3, h, w)
        enter, leave = _INTERSECT[shape](origins[n, :, None, None], direction)
        if n == 0:
            depth.copy_(leave)
            continue
        window = depth[top:bottom, left:right]
        begin = nearest[top:bottom, left:right]
        hit = (enter < leave) & (enter > begin) & (enter < window)
        window.copy_(torch.where(hit, enter, window))
        index[top:bottom, left:right].masked_fill_(hit, n)
    return Hits(depth, index)


def _enter_slabs(origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays enter and leave the slabs -1 < p < 1 of every axis, ``(h, w)`` each."""
    # A ray within a slab meets it far behind and far ahead, not at NaN.
    inverse = torch.where(direction.abs() < 1e-9, 1e9, direction.reciprocal())
    middle = -origin * inverse
    half = inverse.abs()
    return (middle - half).amax(dim=0), (middle + half).amin(dim=0)


def _enter_ball(origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays enter and leave the unit ball (disc in 2D); a miss leaves at -1."""
    # Along the axis of a cylinder the 2D direction may vanish: such a ray never leaves the disc.
    a = direction.square().sum(dim=0).clamp_min(1e-18)
    b = (direction * origin).sum(dim=0) / a
    # The point nearest to the centre: no difference of large squares, as b^2 - ac would be.
    gap = 1 - (origin - b * direction).square().sum(dim=0)
    half = (gap.clamp_min(0) / a).sqrt()
    return -b - half, torch.where(gap > 0, half - b, -1.0)


def _enter_cylinder(origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays enter and leave the unit cylinder around y."""
    enter_caps, leave_caps = _enter_slabs(origin[1:2], direction[1:2])
    enter_side, leave_side = _enter_ball(origin[::2], direction[::2])
    return torch.maximum(enter_caps, enter_side), torch.minimum(leave_caps, leave_side)


_INTERSECT = {BOX: _enter_slabs, ELLIPSOID: _enter_ball, CYLINDER: _enter_cylinder}


def _bounding_rectangles(
    solids: Solids, K: Tensor, cam_from_world: Tensor, *, image_size: tuple[int, int]
) -> Tensor:
    """Pixels ``(N, 4)`` left, top, right, bottom (exclusive) around each solid's box.

    Empty where the box is behind the near plane or outside the image.
    """
    height, width = image_size
    signs = torch.tensor([[i & 1, i >> 1 & 1, i >> 2 & 1] for i in range(8)]) * 2 - 1
    corners = (signs * solids.half_size[:, None]) @ solids.local_from_world
    corners = corners + solids.centre[:, None]
    corners = corners @ cam_from_world[:3, :3].mT + cam_from_world[:3, 3]  # (N, 8, 3)
    # Cut edges at the near plane: what is behind the camera has no projection.
    start, end = corners[:, _EDGES].unbind(dim=2)  # (N, 12, 3)
    z_start, z_end = start[..., 2:], end[..., 2:]
    in_front = (torch.maximum(z_start, z_end) > NEAR)[..., 0]
    rise = torch.where(z_start == z_end, 1.0, z_end - z_start)
    cut = start + (end - start) * ((NEAR - z_start) / rise)
    ends = torch.cat(
        [torch.where(z_start < NEAR, cut, start), torch.where(z_end < NEAR, cut, end)], dim=1
    )
    pixels = ends[..., :2] / ends[..., 2:].clamp_min(NEAR) * K.diagonal()[:2] + K[:2, 2]
    visible = in_front.repeat(1, 2)[..., None]
    # One pixel of slack against rounding.
    low = torch.where(visible, pixels, torch.inf).amin(dim=1).floor() - 1
    high = torch.where(visible, pixels, -torch.inf).amax(dim=1).ceil() + 2
    limit = torch.tensor([width, height], dtype=K.dtype)
    rectangles = torch.cat([low.clamp_min(0).minimum(limit), high.clamp_min(0).minimum(limit)], 1)
    return rectangles.to(torch.int64)
