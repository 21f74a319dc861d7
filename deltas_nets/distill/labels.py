"""A teacher's score map becomes targets of the 65 channels of every 8 x 8 cell.

The layout is that of :func:`deltas_nets.losses.targets.detector_labels` and of the detector's
logits: channel 8 y + x is pixel (x, y) of the cell, channel 64 is "none".

Source: DeTone et al., SuperPoint (2018), section 3.
"""

import torch
import torch.nn.functional as F
from kornia.geometry.subpix import nms2d
from torch import Tensor

from deltas_nets.losses.targets import NMS_RADIUS, in_cells
from deltas_nets.network.lite.detector import CELL

NONE = CELL * CELL
"""Channel of a cell without a point."""


def hard_labels(scores: Tensor, *, threshold: float = 0.1) -> Tensor:
    """The channel of the strongest point in every cell.

    Args:
        scores: ``(B, 1, H, W)`` of a teacher.
        threshold: weaker local maxima are no points.

    Returns:
        ``(B, ceil(H/8), ceil(W/8))`` channel 0..63, or 64 where there is no point.
    """
    best, channel = in_cells(_peaks(scores)).max(dim=1)
    return torch.where(best > threshold, channel, NONE)


def soft_labels(scores: Tensor, *, gain: float = 1.0, blur: float = 0.5) -> Tensor:
    """A distribution over the channels of every cell: the points' scores, the rest "none".

    So the student learns how good a point is and not only where one is, and ranks as the
    teacher does.

    Args:
        scores: ``(B, 1, H, W)`` of a teacher.
        gain: what the scores are multiplied by, for a teacher whose scores are small.
        blur: standard deviation in pixels of the spot that a point becomes; 0 is one pixel. A
            pixel beside the peak is almost right, and a point may lie near the edge of a cell.

    Returns:
        ``(B, 65, ceil(H/8), ceil(W/8))``, not negative, sum 1 over the channels.
    """
    peaks = (gain * _peaks(scores)).clamp(max=1)
    cells = in_cells(_spots(peaks, blur) if blur > 0 else peaks)
    total = cells.sum(dim=1, keepdim=True)
    points = cells / total.clamp_min(1)
    return torch.cat([points, 1 - points.sum(dim=1, keepdim=True)], dim=1).clamp_min(0)


def _peaks(scores: Tensor) -> Tensor:
    window = 2 * NMS_RADIUS + 1
    # kornia leaves out maxima whose window leaves the image; the border's value is repeated
    # lower, so that they are maxima too.
    padded = F.pad(scores, [NMS_RADIUS] * 4, value=-1.0)
    peaks: Tensor = nms2d(padded, (window, window))
    return peaks[..., NMS_RADIUS:-NMS_RADIUS, NMS_RADIUS:-NMS_RADIUS].clamp_min(0)


def _spots(peaks: Tensor, blur: float) -> Tensor:
    """Each peak as a small bell of the same sum."""
    radius = max(1, round(2 * blur))
    place = torch.arange(-radius, radius + 1, dtype=peaks.dtype, device=peaks.device)
    bell = torch.exp(-place.square() / (2 * blur**2))
    bell = bell / bell.sum()
    across = F.conv2d(peaks, bell.view(1, 1, 1, -1), padding=(0, radius))
    return F.conv2d(across, bell.view(1, 1, -1, 1), padding=(radius, 0))
