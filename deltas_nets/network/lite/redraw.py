"""The stage that draws a map anew after several frames agreed on it.

What many maps say is right on average, and vague where depth jumps: each of them has its edges a
little elsewhere. The image shows where they are.
"""

import torch
from torch import Tensor, nn

from deltas_nets.network.features import Channels, Features
from deltas_nets.network.known_depth import KnownDepth, as_points
from deltas_nets.network.lite.densifier import DenseDepth, Densifier

WINDOW = 41
"""Pixels: over squares so wide the map keeps the depth, in the mean of its log, that was agreed on.
What is drawn anew is what differs within them."""


class Redraw(nn.Module):
    """A densifier whose points are a map, and which keeps that map's depth at large.

    Args:
        widths: as of :class:`Densifier`.
        channels: of the features.
    """

    def __init__(self, widths: tuple[int, int, int, int], channels: Channels) -> None:
        super().__init__()
        self.densifier = Densifier(widths, channels)

    def forward(self, features: Features, agreed: KnownDepth) -> DenseDepth:
        """Draw ``(B, 1, H, W)`` depth of the anchor, unknown where it is 0, anew."""
        drawn: DenseDepth = self.densifier(features, as_points(agreed))
        finest, *coarser = drawn.log_depth
        return drawn._replace(log_depth=(kept_at_large(finest, agreed.depth), *coarser))


def kept_at_large(log_depth: Tensor, agreed: Tensor) -> Tensor:
    """A map moved so that its mean around each pixel is that of another one.

    Args:
        log_depth: ``(B, 1, H, W)`` in log metres.
        agreed: ``(B, 1, H, W)`` metres; where it is 0 the map may be what it is.

    Example:
        >>> drawn, agreed = torch.zeros(1, 1, 20, 30), torch.full((1, 1, 20, 30), 2.0)
        >>> round(float(kept_at_large(drawn, agreed).exp().max()), 4)
        2.0
    """
    known = agreed > 0
    off = torch.where(known, torch.where(known, agreed, 1.0).log() - log_depth, 0.0)
    share = _around(known.to(log_depth.dtype))
    return log_depth + _around(off) / share.clamp_min(1e-6)


def _around(image: Tensor) -> Tensor:
    """The mean over the square around each pixel, as much of it as lies within ``(B, 1, H, W)``."""
    # Differences of running sums: F.avg_pool2d of such windows takes 10 ms, a sixth of the stage.
    for axis in (-2, -1):
        size = image.shape[axis]
        sums = image.cumsum(dim=axis, dtype=torch.float64)
        sums = torch.cat([torch.zeros_like(sums.narrow(axis, 0, 1)), sums], dim=axis)
        at = torch.arange(size, device=image.device)
        first, end = (at - WINDOW // 2).clamp_min(0), (at + WINDOW // 2 + 1).clamp_max(size)
        total = sums.index_select(axis, end) - sums.index_select(axis, first)
        count = end - first
        image = (total / (count if axis == -1 else count[:, None])).to(image.dtype)
    return image
