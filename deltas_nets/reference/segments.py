"""Segments of the reference network: kept whole or dropped, never clipped.

Nothing asks whether a point is in front of the source camera. The ends come from two
projections, the direction from the fundamental matrix.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom import to_homogeneous

NEAR, FAR = 0.5, 10.0
"""Depth range that is searched, metres."""
NUM_SAMPLES = 100
"""Samples along a segment."""
OFFSET = 1.0
"""Lines this far on either side of the epipolar line are searched too, pixels."""


class ReferenceSegments(NamedTuple):
    """Where the reference network searches; a dropped segment is a point at pixel (0, 0).

    Attributes:
        near: ``(B, V, N, 2)`` pixel of the key point at the near depth, before any test.
        far: ``(B, V, N, 2)`` pixel at the far depth.
        in_range: ``(B, V, N)`` bool, both ends are in the image and apart.
        center: ``(B, V, N, 2)`` pixels.
        length: ``(B, V, N)`` pixels.
        angle: ``(B, V, N)`` radians, of the direction in which samples follow each other.
    """

    near: Tensor
    far: Tensor
    in_range: Tensor
    center: Tensor
    length: Tensor
    angle: Tensor


def reference_segments(
    keypoints: Tensor, intrinsics: Tensor, cam_from_anchor: Tensor, *, image_size: tuple[int, int]
) -> ReferenceSegments:
    """Segments of the anchor's key points in V sources.

    Args:
        keypoints: ``(B, N, 2)`` pixels of the anchor.
        intrinsics: ``(B, 3, 3)``, the same for all views.
        cam_from_anchor: ``(B, V, 4, 4)`` of the sources, metres.
        image_size: (height, width).
    """
    K = intrinsics[:, None]
    rotation, translation = cam_from_anchor[..., :3, :3], cam_from_anchor[..., :3, 3:]
    homogeneous = to_homogeneous(keypoints)[:, None].mT  # (B, 1, 3, N)
    at_infinity = K @ rotation @ torch.linalg.inv(K) @ homogeneous
    epipole = K @ translation
    near = _dehomogenised(at_infinity + epipole / NEAR)
    far = _dehomogenised(at_infinity + epipole / FAR)

    both = (_in_image(near, image_size) & _in_image(far, image_size))[..., None]
    start, end = torch.where(both, near, 0.0), torch.where(both, far, 0.0)
    length = torch.linalg.vector_norm(end - start, dim=-1)
    a, b, _ = (_fundamental(K, rotation, translation) @ homogeneous).unbind(dim=-2)
    return ReferenceSegments(near, far, length > 0, (start + end) / 2, length, torch.atan2(-a, b))


def segment_samples(
    segments: ReferenceSegments, *, num_samples: int = NUM_SAMPLES, offset: float = OFFSET
) -> Tensor:
    """Positions ``(B, V, N, 3, S, 2)`` of the samples, one row for each line.

    Args:
        segments: where to search.
        num_samples: S along each line.
        offset: of the lines beside the epipolar line, pixels.
    """
    center = segments.center
    along = torch.linspace(-0.5, 0.5, num_samples, device=center.device, dtype=center.dtype)
    return place_on_segments(
        segments.angle[..., None, None],
        center[..., None, None, :],
        segments.length[..., None, None] * along,
        center.new_tensor((-offset, 0.0, offset))[:, None],
    )


def place_on_segments(angle: Tensor, center: Tensor, along: Tensor, across: Tensor) -> Tensor:
    """Pixels ``(..., 2)`` that lie ``along`` a direction and ``across`` it from a centre."""
    cos, sin = angle.cos(), angle.sin()
    x, y = cos * along - sin * across, sin * along + cos * across
    return center + torch.stack([x, y], dim=-1)


def _dehomogenised(rays: Tensor) -> Tensor:
    """Pixels ``(B, V, N, 2)`` of ``(B, V, 3, N)``, also where the ray points backwards."""
    return (rays[..., :2, :] / rays[..., 2:, :]).mT


def _in_image(pixels: Tensor, image_size: tuple[int, int]) -> Tensor:
    height, width = image_size
    x, y = pixels.unbind(dim=-1)
    return (x >= -0.5) & (x < width - 0.5) & (y >= -0.5) & (y < height - 0.5)


def _fundamental(K: Tensor, rotation: Tensor, translation: Tensor) -> Tensor:
    """Fundamental matrix ``(B, V, 3, 3)`` scaled by its last entry unless that is 0.

    For a pure translation the last entry is noise, and so is the sign of the direction: only the
    order of the samples depends on it.
    """
    x, y, z = translation.squeeze(-1).unbind(dim=-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1)
    inverse = torch.linalg.inv(K)
    fundamental: Tensor = inverse.mT @ cross.view(*x.shape, 3, 3) @ rotation @ inverse
    last = fundamental[..., 2:, 2:]
    return fundamental / torch.where(last == 0, 1.0, last)
