"""Densely connected dilated convolutions: context from near and far at one resolution.

Module names are those of the published checkpoint. It calls the block a spatial pyramid, as the
paper does, but pools nothing.

Source: Yang et al., DenseASPP (2018); the paper, section 3.3.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

DILATIONS = (3, 6, 12, 18, 24)


class DensePyramid(nn.Module):
    """Five dilated units, each of which sees the results of all before it.

    Args:
        channels: of the map, before and after.
        growth: channels of a unit's result.
    """

    def __init__(self, channels: int, growth: int) -> None:
        super().__init__()
        seen = [channels + growth * unit for unit in range(len(DILATIONS) + 1)]
        self.daspp_1 = _DilatedUnit(seen[0], growth, DILATIONS[0])
        self.daspp_2 = _DilatedUnit(seen[1], growth, DILATIONS[1])
        self.daspp_3 = _DilatedUnit(seen[2], growth, DILATIONS[2])
        self.daspp_4 = _DilatedUnit(seen[3], growth, DILATIONS[3])
        self.daspp_5 = _DilatedUnit(seen[4], growth, DILATIONS[4])
        self.convf = nn.Conv2d(seen[5], channels, 3, padding=1, bias=False)
        self.bnf = nn.BatchNorm2d(channels)

    def forward(self, x: Tensor) -> Tensor:
        """``(B, channels, h, w)`` of the same shape."""
        units = (self.daspp_1, self.daspp_2, self.daspp_3, self.daspp_4, self.daspp_5)
        for unit in units:
            x = torch.cat([x, unit(x)], dim=1)
        return F.relu(self.bnf(self.convf(x)))


class _DilatedUnit(nn.Module):
    """1x1, then dilated 3x3 convolution."""

    def __init__(self, inputs: int, growth: int, dilation: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, growth, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(growth)
        self.conv2 = nn.Conv2d(growth, growth, 3, padding=dilation, dilation=dilation, bias=False)
        self.bn2 = nn.BatchNorm2d(growth)

    def forward(self, x: Tensor) -> Tensor:
        x = F.relu(self.bn1(self.conv1(x)))
        return F.relu(self.bn2(self.conv2(x)))
