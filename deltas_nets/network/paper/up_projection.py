"""Up-projection: a decoder block that doubles the resolution beside a shortcut.

Between its pixels a map gets zeros, as in unpooling, and a 5x5 convolution fills them. Module
names are those of the published checkpoint.

Source: Laina et al., Deeper depth prediction (2016); the paper, section 3.3 and figure 4.
"""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

Enlarge = Callable[[Tensor, tuple[int, int]], Tensor]
"""Brings ``(B, C, h, w)`` to a size (height, width) about twice as large."""


def insert_zeros(x: Tensor, size: tuple[int, int]) -> Tensor:
    """Pixel (i, j) goes to (2i, 2j), all else is zero.

    Args:
        x: ``(B, C, h, w)``.
        size: (height, width) of the result, at most (2h, 2w).
    """
    height, width = size
    rows, columns = (height + 1) // 2, (width + 1) // 2
    enlarged = x.new_zeros(*x.shape[:2], height, width)
    enlarged[..., ::2, ::2] = x[..., :rows, :columns]
    return enlarged


def enlarge_by_both_axes(x: Tensor, size: tuple[int, int]) -> Tensor:
    """Zeros between the pixels, or the nearest pixel where the size is no multiple in both axes.

    An odd size is no multiple of its half, rounded up. The published weights were trained with
    this choice, although zeros could be inserted and the last row cut off as well.

    Args:
        x: ``(B, C, h, w)``.
        size: (height, width) of the result.
    """
    if size[0] % x.shape[-2] == 0 and size[1] % x.shape[-1] == 0:
        return insert_zeros(x, size)
    return F.interpolate(x, size=size, mode="nearest")


class _Projection(nn.Module):
    """The layers that blocks with and without a skip share."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 5, padding=2, bias=False)
        self.bn1 = nn.BatchNorm2d(outputs)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(outputs)
        self.sc_conv1 = nn.Conv2d(inputs, outputs, 5, padding=2, bias=False)
        self.sc_bn1 = nn.BatchNorm2d(outputs)

    def _begin(self, enlarged: Tensor) -> Tensor:
        return F.relu(self.bn1(self.conv1(enlarged)))

    def _end(self, inner: Tensor, enlarged: Tensor) -> Tensor:
        return F.relu(self.bn2(self.conv2(inner)) + self.sc_bn1(self.sc_conv1(enlarged)))


class UpProjection(_Projection):
    """A block that joins the encoders' map of its resolution.

    Args:
        inputs: channels of the coarse map.
        skip: channels of the joined map.
        outputs: channels of the result.
        enlarge: how the coarse map gets its new size.
    """

    def __init__(
        self, inputs: int, skip: int, outputs: int, *, enlarge: Enlarge = enlarge_by_both_axes
    ) -> None:
        super().__init__(inputs, outputs)
        self.conv1_1 = nn.Conv2d(outputs + skip, outputs, 3, padding=1, bias=False)
        self.bn1_1 = nn.BatchNorm2d(outputs)
        self.enlarge = enlarge

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        """``(B, outputs, h, w)`` of the size of ``skip``."""
        enlarged = self.enlarge(x, (skip.shape[-2], skip.shape[-1]))
        joined = torch.cat([self._begin(enlarged), skip], dim=1)
        return self._end(F.relu(self.bn1_1(self.conv1_1(joined))), enlarged)


class SkiplessUpProjection(_Projection):
    """The last block, from half to full resolution."""

    def forward(self, x: Tensor, *, image_size: tuple[int, int]) -> Tensor:
        """``(B, outputs, H, W)`` from ``(B, inputs, ceil(H/2), ceil(W/2))``."""
        enlarged = insert_zeros(x, image_size)
        return self._end(self._begin(enlarged), enlarged)
