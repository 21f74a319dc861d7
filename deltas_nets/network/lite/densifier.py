"""The densifier makes a dense map, with its own uncertainty, of sparse depth.

The sparse depth is interpolated without parameters (pull-push), and a small U-Net on the
anchor's features corrects it at four scales; the finest of them, at half resolution, is upsampled
to the image's. Working on log depth makes every error relative.
"""

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from deltas_geom import SparseDepth
from deltas_geom.numerics.arithmetic import at_least_single
from deltas_geom.records import Record
from deltas_nets.network.features import Channels, Features
from deltas_nets.network.layers import ConvBlock, upsample_like, zero_initialised
from deltas_nets.network.lite.calibration import SpreadCalibration
from deltas_nets.network.lite.convex_upsampling import ConvexUpsampling, convex_upsample


class DenseDepth(Record):
    """Dense depth of the anchor.

    Attributes:
        log_depth: four ``(B, 1, h, w)`` in log metres: the first at the image's resolution, the
            others at 1/4, 1/8, 1/16 (the paper's: 1/2, 1/4, 1/8).
        log_spread: ``(B, 1, H, W)`` log of the Laplace scale of the error of log depth (the
            paper's: at half that resolution).
    """

    log_depth: tuple[Tensor, ...]
    log_spread: Tensor


class Interpolated(NamedTuple):
    """Sparse log depth spread over the image.

    Attributes:
        log_depth: ``(B, 1, h, w)``.
        deviation: ``(B, 1, h, w)`` standard deviation of what was averaged there.
        weight: ``(B, 1, h, w)`` weight of the points in the cell itself.
        coverage: ``(B, 1, h, w)`` log of the weight around the cell.
        residual: ``(B, 1, h, w)`` log depth of the cell's own points minus ``log_depth``.
    """

    log_depth: Tensor
    deviation: Tensor
    weight: Tensor
    coverage: Tensor
    residual: Tensor


def interpolate_sparse(
    sparse: SparseDepth, *, stride: int = 4, fallback: float = 2.5
) -> Interpolated:
    """Fill the gaps of a sparse depth image by pull-push interpolation.

    Weighted averages go down a pyramid (pull); every cell then keeps its own average as far as
    its weight carries and takes the rest from the next coarser level (push).

    Args:
        sparse: ``(B, 1, H, W)``.
        stride: of the result.
        fallback: depth where the image holds no point at all, metres.

    Source: Gortler et al., The Lumigraph (1996), section 3.4.
    """
    weight = F.avg_pool2d(sparse.weight, stride, ceil_mode=True) * stride**2
    filled = sparse.weight > 0
    log_depth = torch.where(filled, torch.where(filled, sparse.depth, 1.0).log(), 0.0)
    moments = torch.cat([torch.ones_like(log_depth), log_depth, log_depth.square()], dim=1)
    level = F.avg_pool2d(moments * sparse.weight, stride, ceil_mode=True) * stride**2
    levels = [level]
    while min(level.shape[-2:]) > 2:
        level = F.avg_pool2d(level, 2, ceil_mode=True) * 4
        levels.append(level)
    # The whole image's mean is the last resort, and a constant where there is no point.
    log_fallback = math.log(fallback)
    # Not new_tensor, which copies numbers of the host to the device and waits for them.
    powers = [level.new_full((1, 1, 1), log_fallback**power) for power in range(3)]
    default = torch.stack(powers, dim=1)
    total = level.sum(dim=(-2, -1), keepdim=True)
    mean = (total + 1e-6 * default) / (total[:, :1] + 1e-6)
    coverage = total[:, :1]
    for level in reversed(levels):
        mean = mean.expand_as(level) if mean.shape[-1] == 1 else upsample_like(mean, level)
        coverage = upsample_like(coverage, level) / 4
        own = level[:, :1]
        # A tenth of a confident point outweighs what comes from the coarser level.
        mean = (level + 0.1 * mean) / (own + 0.1)
        coverage = coverage + own
    variance = (mean[:, 2:] - mean[:, 1:2].square()).clamp_min(1e-6)
    own_depth = levels[0][:, 1:2] / weight.clamp_min(1e-6)
    residual = torch.where(weight > 1e-3, own_depth - mean[:, 1:2], 0.0)
    return Interpolated(
        mean[:, 1:2], variance.sqrt(), weight, 0.2 * coverage.clamp_min(1e-6).log(), residual
    )


class Densifier(nn.Module):
    """U-Net that corrects the interpolated log depth by what the image shows.

    Args:
        widths: at 1/2, 1/4, 1/8 and 1/16.
        channels: of the features.
    """

    def __init__(self, widths: tuple[int, int, int, int], channels: Channels) -> None:
        super().__init__()
        half, quarter, eighth, sixteenth = widths
        fine, tap2, tap4, tap8, tap16 = channels
        self.enter = ConvBlock(5, half)
        self.down4 = ConvBlock(half + tap4, quarter)
        self.down8 = ConvBlock(quarter, eighth, stride=2)
        self.join8 = ConvBlock(eighth + tap8, eighth)
        self.down16 = ConvBlock(eighth, sixteenth, stride=2)
        self.join16 = nn.Sequential(
            ConvBlock(sixteenth + tap16, sixteenth), ConvBlock(sixteenth, sixteenth)
        )
        self.up8 = ConvBlock(sixteenth + eighth, eighth)
        self.up4 = ConvBlock(eighth + quarter, quarter)
        self.up2 = nn.Sequential(ConvBlock(quarter + tap2 + fine + 1, half), ConvBlock(half, half))
        self.correct = nn.ModuleList(
            [
                zero_initialised(nn.Conv2d(width, 1, 3, padding=1))
                for width in (half, quarter, eighth, sixteenth)
            ]
        )
        self.spread = nn.Conv2d(half, 1, 3, padding=1)
        self.calibration = SpreadCalibration()
        self.upsampling = ConvexUpsampling(half)

    def forward(self, features: Features, sparse: SparseDepth) -> DenseDepth:
        """Densify ``(B, 1, H, W)`` sparse depth of the anchor.

        Depth is predicted at 1/2, 1/4, 1/8 and 1/16; that at 1/2 is given, and supervised, as
        upsampled to the image.
        """
        anchor = features.of_anchor()
        known = interpolate_sparse(sparse)
        # Sparse depth is geometry, in float32 at least, and the maps may be of half precision.
        given = self.enter(torch.cat(known, dim=1).to(anchor.quarter.dtype))
        x4 = self.down4(torch.cat([given, anchor.quarter], dim=1))
        x8 = self.join8(torch.cat([self.down8(x4), anchor.eighth], dim=1))
        x16 = self.join16(torch.cat([self.down16(x8), anchor.sixteenth], dim=1))
        y8 = self.up8(torch.cat([upsample_like(x16, x8), x8], dim=1))
        y4 = self.up4(torch.cat([upsample_like(y8, x4), x4], dim=1))

        correction = at_least_single(self.correct[3](x16))
        depths = [_pooled_like(known.log_depth, correction) + correction]
        for layer, features_here in ((self.correct[2], y8), (self.correct[1], y4)):
            here = at_least_single(layer(features_here))
            correction = upsample_like(correction, features_here) + here
            depths.append(_pooled_like(known.log_depth, correction) + correction)
        base = upsample_like(depths[-1], anchor.half)
        finest = [upsample_like(y4, anchor.half), anchor.half, anchor.fine]
        y2 = self.up2(torch.cat([*finest, base.to(anchor.half.dtype)], dim=1))
        half = base + at_least_single(self.correct[0](y2))
        log_spread = at_least_single(self.spread(y2)).clamp(-6, 2)
        logits = self.upsampling(y2)
        # The last cell of an odd side reaches beyond the image.
        height, width = sparse.depth.shape[-2:]
        depths.append(convex_upsample(half, logits)[..., :height, :width])
        # Doubt follows the edges of depth and must not move them.
        log_spread = convex_upsample(log_spread, logits.detach())[..., :height, :width]
        return DenseDepth(tuple(reversed(depths)), log_spread)


def _pooled_like(fine: Tensor, coarse: Tensor) -> Tensor:
    return F.adaptive_avg_pool2d(fine, (coarse.shape[-2], coarse.shape[-1]))
