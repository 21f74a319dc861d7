"""Descriptors of every view at half resolution, and a coarser map for context."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from deltas_nets.network.encoder import CHANNELS, Features
from deltas_nets.network.layers import ConvBlock, upsample_like

WIDTH = 48
"""Channels of the pyramid, and of the context map."""


class Descriptors(NamedTuple):
    """What points are recognised by.

    Attributes:
        maps: ``(B, V, D, h, w)`` of unit length along D, at 1/2 (the paper: 1/8).
        context: ``(B, V, C, H/8, W/8)``, C = 48 (the paper: 0), what kind of surface this is, in
            a wider surrounding.
    """

    maps: Tensor
    context: Tensor


class Descriptor(nn.Module):
    """Feature pyramid from 1/16 to 1/2, joined there by features straight from the pixels."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        taps = (CHANNELS.half, CHANNELS.quarter, CHANNELS.eighth, CHANNELS.sixteenth)
        self.lateral = nn.ModuleList([nn.Conv2d(int(channels), WIDTH, 1) for channels in taps])
        self.merge = nn.ModuleList([ConvBlock(WIDTH, WIDTH) for _ in taps[:-1]])
        self.head = nn.Sequential(
            ConvBlock(WIDTH + int(CHANNELS.fine), WIDTH), nn.Conv2d(WIDTH, dim, 1)
        )

    def forward(self, features: Features) -> Descriptors:
        """Descriptors of all views."""
        batch = features.half.shape[:2]
        flat = features.flat()
        taps = (flat.half, flat.quarter, flat.eighth, flat.sixteenth)
        pyramid = self.lateral[3](taps[3])
        context = pyramid
        for level in (2, 1, 0):
            lateral = self.lateral[level](taps[level])
            pyramid = self.merge[level](lateral + upsample_like(pyramid, lateral))
            if level == 2:
                context = pyramid
        maps = self.head(torch.cat([pyramid, flat.fine], dim=1)).float()
        unit = F.normalize(maps, dim=1)
        context = context.float()
        return Descriptors(
            unit.reshape(*batch, *unit.shape[1:]), context.reshape(*batch, *context.shape[1:])
        )
