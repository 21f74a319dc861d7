"""Descriptors of every view at half or quarter resolution, and a coarser map for context."""

from typing import Any, Literal, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from deltas_geom.numerics.arithmetic import at_least_single
from deltas_nets.network.features import Channels, Features
from deltas_nets.network.layers import ConvBlock, upsample_like

WIDTH = 48
"""Channels of the pyramid, and of the context map."""


class Descriptors(NamedTuple):
    """What points are recognised by.

    Attributes:
        maps: ``(B, V, D, h, w)`` of unit length along D, at 1/2, or at 1/4 where the config says
            so (the paper: 1/8).
        context: ``(B, V, C, H/8, W/8)``, C = 48 (the paper: 0), what kind of surface this is, in
            a wider surrounding.
    """

    maps: Tensor
    context: Tensor


class Descriptor(nn.Module):
    """Feature pyramid from 1/16 up to the descriptors' resolution.

    At 1/2 it is joined there by features straight from the pixels.

    Args:
        dim: D, channels of the descriptors.
        channels: of the features.
        stride: pixels of the image from one descriptor to the next.
    """

    def __init__(self, dim: int, channels: Channels, stride: Literal[2, 4] = 2) -> None:
        super().__init__()
        self.stride = stride
        taps = self._taps(channels)
        fine = channels.fine if stride == 2 else 0
        self.lateral = nn.ModuleList([nn.Conv2d(inputs, WIDTH, 1) for inputs in taps])
        self.merge = nn.ModuleList([ConvBlock(WIDTH, WIDTH) for _ in taps[:-1]])
        self.head = nn.Sequential(ConvBlock(WIDTH + fine, WIDTH), nn.Conv2d(WIDTH, dim, 1))

    def forward(self, features: Features) -> Descriptors:
        """Descriptors of all views."""
        batch = features.half.shape[:2]
        flat = features.flat()
        *finer, sixteenth = self._taps(flat)
        pyramid = self.lateral[len(finer)](sixteenth)
        coarse_to_fine = []
        for level in reversed(range(len(finer))):
            lateral = self.lateral[level](finer[level])
            pyramid = self.merge[level](lateral + upsample_like(pyramid, lateral))
            coarse_to_fine.append(pyramid)
        context = at_least_single(coarse_to_fine[0])
        if self.stride == 2:
            pyramid = torch.cat([pyramid, flat.fine], dim=1)
        unit = F.normalize(at_least_single(self.head(pyramid)), dim=1)
        return Descriptors(
            unit.reshape(*batch, *unit.shape[1:]), context.reshape(*batch, *context.shape[1:])
        )

    def _taps(self, maps: Features | Channels) -> tuple[Any, ...]:
        """The maps that the pyramid reads, fine to coarse."""
        coarser = (maps.quarter, maps.eighth, maps.sixteenth)
        return (maps.half, *coarser) if self.stride == 2 else coarser
