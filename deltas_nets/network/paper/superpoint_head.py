"""Detector and descriptor heads on a backbone's taps, as the paper extends SuperPoint.

Module names are those of the published checkpoint.

Source: DeTone et al., SuperPoint (2018); the paper, section 3.1 and figure 2.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from deltas_nets.network.lite.detector import CELL
from deltas_nets.network.paper.taps import TapChannels, Taps


class DetectorStages(NamedTuple):
    """What the detector head computes.

    Attributes:
        upsampled: ``(B, width, H//8, W//8)`` the deepest tap, reduced and enlarged.
        logits: ``(B, 65, H//8, W//8)``; channel 8 r + c is pixel (row r, column c) of the 8x8
            cell, the last is "none".
    """

    upsampled: Tensor
    logits: Tensor


class DetectorHead(nn.Module):
    """Interest points from the deepest tap.

    Args:
        channels: of the backbone's taps.
        width: of the first convolution; the second has half of it.
    """

    def __init__(self, channels: TapChannels, width: int = 256) -> None:
        super().__init__()
        self.convPa = nn.Conv2d(channels[-1], width, 3, padding=1)
        self.bnPa = nn.BatchNorm2d(width)
        self.convPb = nn.Conv2d(width, width // 2, 3, padding=1)
        self.bnPb = nn.BatchNorm2d(width // 2)
        self.convPc = nn.Conv2d(width // 2, CELL * CELL + 1, 1)

    def forward(self, taps: Taps, *, image_size: tuple[int, int]) -> DetectorStages:
        """Logits of every 8x8 cell.

        Args:
            taps: of B images.
            image_size: (height, width), at least (8, 8).
        """
        reduced = F.relu(self.bnPa(self.convPa(taps.deepest)))
        upsampled = _resized(reduced, image_size)
        logits = self.convPc(F.relu(self.bnPb(self.convPb(upsampled))))
        return DetectorStages(upsampled, logits)


class DescriptorStages(NamedTuple):
    """What the descriptor head computes.

    Attributes:
        joined_eighth: the deepest tap, reduced and enlarged, beside the eighth.
        joined_fine: both, reduced, beside the quarter and the half.
        raw: ``(B, D, H//8, W//8)`` descriptors of any length.
        unit: ``(B, D, H//8, W//8)`` of unit length along D.
    """

    joined_eighth: Tensor
    joined_fine: Tensor
    raw: Tensor
    unit: Tensor


class DescriptorHead(nn.Module):
    """Descriptors at 1/8 from all taps but the sixteenth.

    Args:
        channels: of the backbone's taps.
        dim: channels of the descriptors.
        width: of the inner convolutions.
    """

    def __init__(self, channels: TapChannels, dim: int = 128, width: int = 256) -> None:
        super().__init__()
        half, quarter, eighth, _, deepest = channels
        self.convDa = nn.Conv2d(deepest, width // 2, 3, padding=1)
        self.bnDa = nn.BatchNorm2d(width // 2)
        self.convDb = nn.Conv2d(width // 2 + eighth, width, 1)
        self.bnDb = nn.BatchNorm2d(width)
        self.convDc = nn.Conv2d(width, width, 3, padding=1)
        self.bnDc = nn.BatchNorm2d(width)
        self.convDd = nn.Conv2d(width + quarter + half, dim, 1)

    def forward(self, taps: Taps, *, image_size: tuple[int, int]) -> DescriptorStages:
        """Descriptors of every 8x8 cell.

        Args:
            taps: of B images.
            image_size: (height, width), at least (8, 8).
        """
        coarse = _resized(F.relu(self.bnDa(self.convDa(taps.deepest))), image_size)
        joined_eighth = torch.cat([coarse, _resized(taps.eighth, image_size)], dim=1)
        reduced = F.relu(self.bnDb(self.convDb(joined_eighth)))
        reduced = F.relu(self.bnDc(self.convDc(reduced)))
        fine = [_resized(tap, image_size) for tap in (taps.quarter, taps.half)]
        joined_fine = torch.cat([reduced, *fine], dim=1)
        raw = self.convDd(joined_fine)
        return DescriptorStages(joined_eighth, joined_fine, raw, F.normalize(raw, dim=1))


def _resized(feature: Tensor, image_size: tuple[int, int]) -> Tensor:
    """A map at (H//8, W//8), bilinear, without antialiasing."""
    size = (image_size[0] // CELL, image_size[1] // CELL)
    if feature.shape[-2:] == size:
        return feature
    return F.interpolate(feature, size=size, mode="bilinear", align_corners=False)
