"""Layers that several parts of the network share."""

import torch.nn.functional as F
from torch import Tensor, nn

from deltas_geom.numerics.arithmetic import promoted
from deltas_nets.network.conv_norm import conv_norm


class ConvBlock(nn.Sequential):
    """Convolution, batch norm, ReLU."""

    def __init__(self, inputs: int, outputs: int, *, stride: int = 1, kernel: int = 3) -> None:
        super().__init__(
            nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False),
            nn.BatchNorm2d(outputs),
            nn.ReLU(inplace=True),
        )

    def forward(self, input: Tensor) -> Tensor:
        """``(B, inputs, H, W)`` to ``(B, outputs, H / stride, W / stride)``."""
        conv, norm, _ = self
        assert isinstance(conv, nn.Conv2d)
        return F.relu(conv_norm(input, conv, norm), inplace=True)


class WideLinear(nn.Linear):
    """A linear layer in the dtype to which its input and its weights promote.

    Layers that read geometry need it: in a network of half precision geometry stays in float32.
    """

    def forward(self, input: Tensor) -> Tensor:
        """``(*B, inputs)`` to ``(*B, outputs)``."""
        return F.linear(*promoted(input, self.weight, self.bias))


class WideRowConv(nn.Conv1d):
    """A convolution with a bias along the rows of maps, as :class:`WideLinear`."""

    def forward(self, input: Tensor) -> Tensor:
        """``(B, inputs, N, S)`` to ``(B, outputs, N, S)``: all N rows of S by the same kernel."""
        assert self.bias is not None and isinstance(self.padding, tuple)
        input, weight, bias = promoted(input, self.weight, self.bias)
        # In two dims: as N images of one row, the same takes twice as long.
        return F.conv2d(input, weight.unsqueeze(-2), bias, padding=(0, *self.padding))


class WideBatchNorm1d(nn.BatchNorm1d):
    """Batch norm, as :class:`WideLinear`; its statistics are kept in their own dtype."""

    def forward(self, input: Tensor) -> Tensor:
        """``(B, C)`` of the same shape."""
        if input.dtype == self.weight.dtype:
            return super().forward(input)
        assert self.running_mean is not None and self.running_var is not None
        assert self.num_batches_tracked is not None and self.momentum is not None
        input, mean, variance, weight, bias = promoted(
            input, self.running_mean, self.running_var, self.weight, self.bias
        )
        normed = F.batch_norm(
            input, mean, variance, weight, bias, self.training, self.momentum, self.eps
        )
        if self.training:
            self.running_mean.copy_(mean)
            self.running_var.copy_(variance)
            self.num_batches_tracked.add_(1)
        return normed


def upsample_like(coarse: Tensor, fine: Tensor) -> Tensor:
    """Resize ``(B, C, h, w)`` bilinearly to the height and width of ``fine``."""
    return upsample_to(coarse, (fine.shape[-2], fine.shape[-1]))


def upsample_to(coarse: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize ``(B, C, h, w)`` bilinearly to (height, width)."""
    return F.interpolate(coarse, size=size, mode="bilinear", align_corners=False)


def zero_initialised(layer: nn.Conv1d | nn.Conv2d) -> nn.Conv1d | nn.Conv2d:
    """A correction that is 0 at the start."""
    nn.init.zeros_(layer.weight)
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)
    return layer
