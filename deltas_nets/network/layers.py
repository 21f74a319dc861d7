"""Layers that several parts of the network share."""

import torch.nn.functional as F
from torch import Tensor, nn


class ConvBlock(nn.Sequential):
    """Convolution, batch norm, ReLU."""

    def __init__(self, inputs: int, outputs: int, *, stride: int = 1, kernel: int = 3) -> None:
        super().__init__(
            nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False),
            nn.BatchNorm2d(outputs),
            nn.ReLU(inplace=True),
        )


def upsample_like(coarse: Tensor, fine: Tensor) -> Tensor:
    """Resize ``(B, C, h, w)`` bilinearly to the height and width of ``fine``."""
    return upsample_to(coarse, (fine.shape[-2], fine.shape[-1]))


def upsample_to(coarse: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize ``(B, C, h, w)`` bilinearly to (height, width)."""
    return F.interpolate(coarse, size=size, mode="bilinear", align_corners=False)


def zero_initialised(layer: nn.Conv1d | nn.Conv2d) -> nn.Conv1d | nn.Conv2d:
    """A correction that starts as none."""
    nn.init.zeros_(layer.weight)
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)
    return layer
