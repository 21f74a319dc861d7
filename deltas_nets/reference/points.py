"""Triangulation of the reference network, and the sparse depth image it draws."""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_nets.reference.segments import FAR, NEAR

_LARGEST = 1000.0


class ReferencePoints(NamedTuple):
    """Points by weighted linear triangulation in pixels.

    Attributes:
        system: ``(B, N, 2 + 2V, 4)`` weighted rows, x and y of each view, the anchor first.
        singular_values: ``(B, N, 4)`` descending.
        points: ``(B, N, 3)`` in the anchor's camera, metres.
    """

    system: Tensor
    singular_values: Tensor
    points: Tensor


def triangulate_pixels(
    pixels: Tensor, weights: Tensor, intrinsics: Tensor, cam_from_anchor: Tensor
) -> ReferencePoints:
    """Triangulate without conditioning, in the precision of the inputs.

    Args:
        pixels: ``(B, 1 + V, N, 2)``, the anchor first.
        weights: ``(B, 1 + V, N)``.
        intrinsics: ``(B, 3, 3)``, the same for all views.
        cam_from_anchor: ``(B, V, 4, 4)`` of the sources.
    """
    anchor = torch.eye(4, device=pixels.device, dtype=pixels.dtype).expand(len(pixels), 1, 4, 4)
    proj = intrinsics[:, None] @ torch.cat([anchor, cam_from_anchor], dim=1)[..., :3, :]
    proj = proj[:, :, None]  # (B, 1 + V, 1, 3, 4)
    rows = pixels[..., None] * proj[..., 2:, :] - proj[..., :2, :]
    system = (weights[..., None, None] * rows).transpose(1, 2).flatten(2, 3)
    _, singular_values, right = torch.linalg.svd(system, full_matrices=False)
    null = right[..., -1, :]
    points = null[..., :3] / null[..., 3:]
    return ReferencePoints(system, singular_values, clamp_if_infinite(points))


def clamp_if_infinite(points: Tensor) -> Tensor:
    """Points of a batch, all of them within +-1000 if one coordinate of one is infinite."""
    return points.clamp(-_LARGEST, _LARGEST) if points.isinf().any() else points


def draw_sparse_depth(
    keypoints: Tensor, points: Tensor, seen: Tensor, *, image_size: tuple[int, int]
) -> Tensor:
    """Sparse depth image ``(B, 1, H, W)``, metres.

    A key point without a depth in range writes 0. Where two meet, the later one wins, valid or
    not; the original left this to the device, and on a CPU it came out so.

    Args:
        keypoints: ``(B, N, 2)`` pixels of the anchor, truncated to whole ones; those outside the
            image write nothing.
        points: ``(B, N, 3)`` in the anchor's camera.
        seen: ``(B, N)`` bool, any source has the point in range.
        image_size: (height, width).
    """
    height, width = image_size
    depth = points[..., 2].clamp(0, FAR)
    valid = seen & (depth > NEAR) & (depth < FAR)
    column, row = keypoints.long().unbind(dim=-1)
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    pixel = torch.where(inside, row * width + column, height * width)  # one more takes the rest
    order = torch.arange(1, pixel.shape[1] + 1, device=pixel.device).expand_as(pixel)
    last = order.new_zeros(len(pixel), height * width + 1).scatter_reduce(1, pixel, order, "amax")
    values = torch.cat([depth.new_zeros(len(depth), 1), torch.where(valid, depth, 0.0)], dim=1)
    return values.gather(1, last[:, :-1]).view(-1, 1, height, width)
