"""Twice the resolution with edges kept: every pixel mixes the coarse values around it.

The network chooses the mixture from what the image shows, so that a pixel beside an edge can take
its depth from its own side alone, where bilinear weights would invent a surface in between.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from deltas_geom.checks import check_shapes
from deltas_geom.numerics.arithmetic import outside_gradients
from deltas_nets.network.layers import zero_initialised

FACTOR = 2
"""How much finer the result is."""
WINDOW = 3
"""A pixel mixes WINDOW x WINDOW coarse values, centred on the cell that it lies in."""
NUM_LOGITS = FACTOR**2 * WINDOW**2
FAINT = 1e-4
"""What a neighbour that bilinear upsampling leaves out weighs at first: a softmax gives no zero,
and only a weight above zero can grow."""


def convex_upsample(coarse: Tensor, logits: Tensor) -> Tensor:
    """Upsample by 2; no result leaves the range of the 3 x 3 coarse values around it.

    Beyond the border the outermost values go on. Halves are computed in single precision.

    Args:
        coarse: ``(B, C, h, w)``.
        logits: ``(B, 36, h, w)`` of the weights: for the upper left, upper right, lower left and
            lower right pixel of a cell in turn, 9 neighbours row by row.

    Returns:
        ``(B, C, 2h, 2w)``, of the dtype of ``coarse``.

    Raises:
        ShapeError: a trailing shape differs.

    Source: Teed and Deng, RAFT (2020), section 3.3.
    """
    check_shapes(coarse=(coarse, "C h w"), logits=(logits, f"{NUM_LOGITS} h w"))
    precision = torch.promote_types(coarse.dtype, torch.float32)
    height, width = coarse.shape[-2:]
    each = logits.to(precision).reshape(-1, FACTOR**2, WINDOW**2, height, width)
    weights = each.softmax(dim=2)
    reach = WINDOW // 2
    padded = F.pad(coarse.to(precision), (reach, reach, reach, reach), mode="replicate")
    # Slices rather than F.unfold: as fast, and ONNX has no counterpart of unfold.
    shifted = [
        padded[..., row : row + height, column : column + width]
        for row in range(WINDOW)
        for column in range(WINDOW)
    ]
    mixed = (weights[:, None] * torch.stack(shifted, dim=2)[:, :, None]).sum(dim=3)
    return F.pixel_shuffle(mixed.flatten(1, 2), FACTOR).to(coarse.dtype)


class ConvexUpsampling(nn.Module):
    """Makes the logits of :func:`convex_upsample`; untrained, it makes those of bilinear."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv = zero_initialised(nn.Conv2d(channels, NUM_LOGITS, WINDOW, padding=WINDOW // 2))
        assert self.conv.bias is not None
        with outside_gradients():
            self.conv.bias.copy_(bilinear_logits())

    def forward(self, features: Tensor) -> Tensor:
        """Logits ``(B, 36, h, w)`` from ``(B, C, h, w)``."""
        logits: Tensor = self.conv(features)
        return logits


def bilinear_logits() -> Tensor:
    """``(36,)`` logits with which :func:`convex_upsample` is bilinear (``align_corners=False``)."""
    # A pixel's centre is a quarter of a cell from that of its cell, towards one neighbour.
    along = torch.tensor([[1 / 4, 3 / 4, 0], [0, 3 / 4, 1 / 4]])
    weights = torch.einsum("yr,xc->yxrc", along, along)
    return weights.clamp_min(FAINT).log().flatten()
