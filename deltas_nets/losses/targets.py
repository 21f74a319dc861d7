"""What the network should have found: from true depth and poses."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from kornia.feature import gftt_response
from kornia.geometry.subpix import nms2d
from torch import Tensor

from deltas_geom import PosedViews, in_image, project, unproject
from deltas_nets.network.lite.detector import CELL

NMS_RADIUS = 2
"""Pixels between interest points, along an axis."""
QUALITY = 0.01
"""Weakest response of an interest point, as a share of the image's strongest."""
OCCLUSION_TOLERANCE = 0.04
"""A point is hidden where a source sees something nearer by more than this share of its depth."""


class Targets(NamedTuple):
    """Truth about the anchor's keypoints.

    Attributes:
        depth: ``(B, N)`` along the anchor's z, metres; 0 = unknown.
        known: ``(B, N)`` bool: the depth is known and in range.
        points: ``(B, N, 3)`` world points, metres.
        pixels: ``(B, V, N, 2)`` where they are.
        visible: ``(B, V, N)`` bool: in the image and not hidden by something nearer.
    """

    depth: Tensor
    known: Tensor
    points: Tensor
    pixels: Tensor
    visible: Tensor


def keypoint_targets(
    views: PosedViews,
    depth: Tensor,
    keypoints: Tensor,
    *,
    depth_range: tuple[float, float],
) -> Targets:
    """True depth, points and matches of keypoints.

    Args:
        views: true poses of V views.
        depth: ``(B, V, H, W)`` metres, 0 = unknown.
        keypoints: ``(B, N, 2)`` of the anchor.
        depth_range: (near, far) metres.
    """
    size = (depth.shape[-2], depth.shape[-1])
    at_keypoints = read_nearest(depth[:, :1], keypoints[:, None])[:, 0]
    known = (at_keypoints > depth_range[0]) & (at_keypoints < depth_range[1])
    safe = torch.where(known, at_keypoints, 1.0)
    points = unproject(views.select(0), keypoints[:, None], safe[:, None])[:, 0]
    there = project(views, points)
    surface = read_nearest(depth, there.pixels)
    not_hidden = (surface > 0) & (there.depth < surface * (1 + OCCLUSION_TOLERANCE))
    visible = there.in_front & in_image(there.pixels, image_size=size) & not_hidden
    return Targets(
        torch.where(known, at_keypoints, 0.0),
        known,
        points,
        there.pixels,
        visible & known[:, None],
    )


def read_nearest(maps: Tensor, pixels: Tensor) -> Tensor:
    """Values ``(*B, N)`` of maps ``(*B, H, W)`` at the pixels ``(*B, N, 2)`` they contain.

    Depth is read without interpolation: the mean over an edge is the depth of no surface. Pixels
    outside read the border.
    """
    height, width = maps.shape[-2:]
    column, row = (pixels + 0.5).floor().long().unbind(dim=-1)
    index = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
    return maps.flatten(-2).gather(-1, index)


def detector_labels(images: Tensor) -> Tensor:
    """Which pixel of each 8 x 8 cell is an interest point, ``(B, ceil(H/8), ceil(W/8))``.

    Interest points are local maxima of the Shi-Tomasi response.

    Args:
        images: ``(B, 3, H, W)`` RGB in [0, 1].

    Returns:
        Channel 0..63 of the strongest point in the cell, row by row; 64 where there is none.

    Source: Shi and Tomasi, Good features to track (1994); labels as in SuperPoint.
    """
    grey = images.mean(dim=1, keepdim=True)
    response = gftt_response(grey)
    peaks = nms2d(response, (2 * NMS_RADIUS + 1, 2 * NMS_RADIUS + 1))
    strongest = response.amax(dim=(-2, -1), keepdim=True)
    peaks = torch.where(peaks > QUALITY * strongest, peaks, 0.0)
    best, channel = in_cells(peaks).max(dim=1)
    return torch.where(best > 0, channel, CELL * CELL)


def in_cells(maps: Tensor) -> Tensor:
    """``(B, 64, ceil(H/8), ceil(W/8))`` of ``(B, 1, H, W)``; beyond the image there is 0."""
    height, width = maps.shape[-2:]
    return F.pixel_unshuffle(F.pad(maps, (0, -width % CELL, 0, -height % CELL)), CELL)
