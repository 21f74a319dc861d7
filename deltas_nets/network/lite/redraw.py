"""The stage that draws a map anew after several frames agreed on it.

What many maps say is right on average, and vague where depth jumps: each of them has its edges a
little elsewhere. The image shows where they are.
"""

import torch
import torch.nn.functional as F
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
    # Along one axis and then the other: a square of 41 pixels at once costs 20 times as much.
    for window in ((WINDOW, 1), (1, WINDOW)):
        reach = (window[0] // 2, window[1] // 2)
        image = F.avg_pool2d(image, window, stride=1, padding=reach, count_include_pad=False)
    return image
