"""From a cost volume and the anchor's features to a dense map at four scales, all in 2D."""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from deltas_geom.numerics.arithmetic import at_least_single
from deltas_nets.network.features import Channels, Features
from deltas_nets.network.layers import ConvBlock, upsample_like, zero_initialised
from deltas_nets.network.lite.calibration import SpreadCalibration
from deltas_nets.network.lite.convex_upsampling import ConvexUpsampling, convex_upsample
from deltas_nets.network.lite.densifier import DenseDepth


class Planes(NamedTuple):
    """A cost volume.

    Attributes:
        difference: ``(B, S, h, w)`` of the sources from the anchor, at a quarter of the
            image's resolution.
        inv_depths: ``(S,)`` evenly spaced, from far to near, 1/m.
    """

    difference: Tensor
    inv_depths: Tensor


class VolumeDecoder(nn.Module):
    """U-Net over the planes as channels; its fine end is that of our densifier.

    Inverse depth is the mean over planes of a softmax at 1/4, which begins at the differences as
    they are, and a sigmoid at 1/8 and 1/16.

    Args:
        widths: at 1/2, 1/4, 1/8 and 1/16.
        channels: of the features.
        planes: S.
    """

    def __init__(self, widths: tuple[int, int, int, int], channels: Channels, planes: int) -> None:
        super().__init__()
        half, quarter, eighth, sixteenth = widths
        fine, tap2, tap4, tap8, tap16 = channels
        self.enter = nn.Sequential(ConvBlock(planes + tap4, quarter), ConvBlock(quarter, quarter))
        self.down8 = ConvBlock(quarter, eighth, stride=2)
        self.join8 = ConvBlock(eighth + tap8, eighth)
        self.down16 = ConvBlock(eighth, sixteenth, stride=2)
        self.join16 = nn.Sequential(
            ConvBlock(sixteenth + tap16, sixteenth), ConvBlock(sixteenth, sixteenth)
        )
        self.up8 = nn.Sequential(ConvBlock(sixteenth + eighth, eighth), ConvBlock(eighth, eighth))
        self.up4 = nn.Sequential(ConvBlock(eighth + quarter, quarter), ConvBlock(quarter, quarter))
        self.up2 = nn.Sequential(ConvBlock(quarter + tap2 + fine + 1, half), ConvBlock(half, half))
        self.coarse = nn.ModuleList(
            [zero_initialised(nn.Conv2d(width, 1, 3, padding=1)) for width in (eighth, sixteenth)]
        )
        self.logits = zero_initialised(nn.Conv2d(quarter, planes, 3, padding=1))
        self.sharpness = nn.Parameter(torch.tensor(3.0))
        self.correct = zero_initialised(nn.Conv2d(half, 1, 3, padding=1))
        self.spread = nn.Conv2d(half, 1, 3, padding=1)
        self.calibration = SpreadCalibration()
        self.upsampling = ConvexUpsampling(half)

    def forward(self, anchor: Features, planes: Planes, image_size: tuple[int, int]) -> DenseDepth:
        """Depth of the anchor, as :class:`DenseDepth`.

        Args:
            anchor: its features, ``(B, C, h, w)``.
            planes: the volume.
            image_size: (height, width) of the image.
        """
        volume = planes.difference.to(anchor.quarter.dtype)
        x4 = self.enter(torch.cat([volume, anchor.quarter], dim=1))
        x8 = self.join8(torch.cat([self.down8(x4), anchor.eighth], dim=1))
        x16 = self.join16(torch.cat([self.down16(x8), anchor.sixteenth], dim=1))
        y8 = self.up8(torch.cat([upsample_like(x16, x8), x8], dim=1))
        y4 = self.up4(torch.cat([upsample_like(y8, x4), x4], dim=1))

        far, near = planes.inv_depths[0], planes.inv_depths[-1]
        coarse = [
            (far + (near - far) * at_least_single(layer(each)).sigmoid()).log().neg()
            for layer, each in zip(self.coarse, (y8, x16), strict=True)
        ]
        logits = at_least_single(self.logits(y4)) - self.sharpness.exp() * planes.difference
        share = logits.softmax(dim=1)
        quarter = (share * planes.inv_depths[:, None, None]).sum(dim=1, keepdim=True).log().neg()

        base = upsample_like(quarter, anchor.half)
        finest = [upsample_like(y4, anchor.half), anchor.half, anchor.fine]
        y2 = self.up2(torch.cat([*finest, base.to(anchor.half.dtype)], dim=1))
        log_depth = base + at_least_single(self.correct(y2))
        log_spread = at_least_single(self.spread(y2)).clamp(-6, 2)
        mixture = self.upsampling(y2)
        height, width = image_size
        full = convex_upsample(log_depth, mixture)[..., :height, :width]
        log_spread = convex_upsample(log_spread, mixture.detach())[..., :height, :width]
        return DenseDepth((full, quarter, *coarse), log_spread)
