"""A convolution and the batch norm after it, as one convolution where the statistics stand still.

A map of 96 channels is large, and a norm of its own reads and writes all of it; weights are small.
Gradients are those of the two, so that a network may be trained with frozen statistics as well.
"""

import copy
from typing import TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from deltas_geom.numerics.arithmetic import at_least_single, in_dtype


def conv_norm(x: Tensor, conv: nn.Conv2d, norm: nn.Module) -> Tensor:
    """``norm(conv(x))``.

    Args:
        x: ``(B, C, H, W)``.
        conv: without bias.
        norm: batch norm of the convolution's channels, shared between processes or not.
    """
    if norm.training and not isinstance(norm, Affine):
        normed: Tensor = norm(conv(x))
        return normed
    assert conv.bias is None
    slope, shift = (norm.slope, norm.shift) if isinstance(norm, Affine) else _affine(norm)
    dtype = conv.weight.dtype
    folded: Tensor = conv._conv_forward(
        x, in_dtype(conv.weight * slope.view(-1, 1, 1, 1), dtype), in_dtype(shift, dtype)
    )
    return folded


def _affine(norm: nn.Module) -> tuple[Tensor, Tensor]:
    """What a norm whose statistics stand still multiplies each channel with, and then adds."""
    assert isinstance(norm, nn.BatchNorm2d | nn.SyncBatchNorm)
    assert norm.running_mean is not None and norm.running_var is not None
    variance, mean = at_least_single(norm.running_var), at_least_single(norm.running_mean)
    slope = norm.weight * torch.rsqrt(variance + norm.eps)
    return slope, norm.bias - mean * slope


class Affine(nn.Module):
    """A batch norm of which nothing will change, as its factor and shift of each channel.

    Args:
        norm: in eval mode.
    """

    slope: Tensor
    shift: Tensor

    def __init__(self, norm: nn.BatchNorm2d) -> None:
        super().__init__()
        slope, shift = _affine(norm)
        self.register_buffer("slope", slope.detach())
        self.register_buffer("shift", shift.detach())

    def forward(self, x: Tensor) -> Tensor:
        """``(B, C, H, W)``, as by the norm."""
        slope, shift = (each.view(-1, 1, 1) for each in (self.slope, self.shift))
        return in_dtype(x * slope + shift, x.dtype)


Network = TypeVar("Network", bound=nn.Module)


def with_affine_norms(network: Network) -> Network:
    """A copy whose norms will not change, for traces, which repeat what is done at every call."""
    network = copy.deepcopy(network)
    for module in list(network.modules()):
        for name, child in module.named_children():
            if isinstance(child, nn.BatchNorm2d):
                setattr(module, name, Affine(child))
    return network


class SameConv(nn.Conv2d):
    """Convolution padded as TensorFlow does ("same"), which pretrained weights may expect.

    An uneven rim is padded at the kernel: a zero before it and an even rim are the same, and the
    map need not be copied.
    """

    def _conv_forward(self, input: Tensor, weight: Tensor, bias: Tensor | None) -> Tensor:
        rim_y, before_y = self._rim(input.shape[-2], axis=0)
        rim_x, before_x = self._rim(input.shape[-1], axis=1)
        if before_x or before_y:
            weight = F.pad(weight, (before_x, 0, before_y, 0))
        return F.conv2d(input, weight, bias, self.stride, (rim_y, rim_x), 1, self.groups)

    def _rim(self, size: int, *, axis: int) -> tuple[int, int]:
        """Rows that the map lacks at its end, and how many fewer it lacks at its start."""
        kernel, stride = self.kernel_size[axis], self.stride[axis]
        missing = max((-(-size // stride) - 1) * stride + kernel - size, 0)
        after = missing - missing // 2
        return after, after - missing // 2
