"""The paper's sparse-to-dense network: two encoders joined at every scale, one decoder.

Module names are those of the published checkpoint; its table is the encoder's and the decoder's
in one.

Source: the paper, section 3.3 and figure 4; Chen et al., Estimating depth from RGB and sparse
sensing (2018).
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from deltas_nets.network.paper.dense_pyramid import DensePyramid
from deltas_nets.network.paper.taps import Backbone, TapChannels, Taps
from deltas_nets.network.paper.up_projection import (
    Enlarge,
    SkiplessUpProjection,
    UpProjection,
    enlarge_by_both_axes,
)

DecoderWidths = tuple[int, int, int, int, int]
"""Channels of the decoder's blocks, coarse to fine."""


class DecoderMaps(NamedTuple):
    """Results of the decoder's blocks, coarse to fine.

    Attributes:
        sixteenth: ``(B, C, ceil(H/16), ceil(W/16))``.
        eighth: ``(B, C, ceil(H/8), ceil(W/8))``.
        pyramid: of the same shape; what the finer blocks go on with.
        quarter: ``(B, C, ceil(H/4), ceil(W/4))``.
        half: ``(B, C, ceil(H/2), ceil(W/2))``.
        full: ``(B, C, H, W)``.
    """

    sixteenth: Tensor
    eighth: Tensor
    pyramid: Tensor
    quarter: Tensor
    half: Tensor
    full: Tensor


class DepthScales(NamedTuple):
    """What the decoder predicts at four scales, linear and without bounds.

    It is depth in metres in the reference network, where nothing keeps it positive.

    Attributes:
        full: ``(B, 1, H, W)``.
        half: ``(B, 1, ceil(H/2), ceil(W/2))``.
        quarter: ``(B, 1, ceil(H/4), ceil(W/4))``.
        eighth: ``(B, 1, ceil(H/8), ceil(W/8))``.
    """

    full: Tensor
    half: Tensor
    quarter: Tensor
    eighth: Tensor


class DepthDecoder(nn.Module):
    """Up-projections from the deepest map to the image, and a depth at each of four scales.

    Args:
        channels: of the joined taps.
        widths: of the five blocks.
        enlarge: how maps get their new size before the blocks with a skip.
    """

    def __init__(
        self,
        channels: TapChannels,
        widths: DecoderWidths,
        *,
        enlarge: Enlarge = enlarge_by_both_axes,
    ) -> None:
        super().__init__()
        half, quarter, eighth, sixteenth, deepest = channels
        first, second, third, fourth, fifth = widths
        self.gud_up_proj_layer1 = UpProjection(deepest, sixteenth, first, enlarge=enlarge)
        self.gud_up_proj_layer2 = UpProjection(first, eighth, second, enlarge=enlarge)
        self.ASPP = DensePyramid(second, second // 2)
        self.gud_up_proj_layer3 = UpProjection(second, quarter, third, enlarge=enlarge)
        self.gud_up_proj_layer4 = UpProjection(third, half, fourth, enlarge=enlarge)
        self.gud_up_proj_layer5 = SkiplessUpProjection(fourth, fifth)
        self.conv_final = nn.Conv2d(fifth, 1, 3, padding=1)
        self.conv_scale8 = nn.Conv2d(second, 1, 1)
        self.conv_scale4 = nn.Conv2d(third, 1, 1)
        self.conv_scale2 = nn.Conv2d(fourth, 1, 1)

    def forward(self, joined: Taps, *, image_size: tuple[int, int]) -> DecoderMaps:
        """Maps of all blocks."""
        sixteenth = self.gud_up_proj_layer1(joined.deepest, joined.sixteenth)
        eighth = self.gud_up_proj_layer2(sixteenth, joined.eighth)
        pyramid = self.ASPP(eighth)
        quarter = self.gud_up_proj_layer3(pyramid, joined.quarter)
        half = self.gud_up_proj_layer4(quarter, joined.half)
        full = self.gud_up_proj_layer5(half, image_size=image_size)
        return DecoderMaps(sixteenth, eighth, pyramid, quarter, half, full)

    def depths(self, maps: DecoderMaps) -> DepthScales:
        """Depth that the maps stand for."""
        return DepthScales(
            full=self.conv_final(maps.full),
            half=self.conv_scale2(maps.half),
            quarter=self.conv_scale4(maps.quarter),
            eighth=self.conv_scale8(maps.pyramid),
        )


class SparseDensifier(nn.Module):
    """Dense depth of the anchor from its image's taps and its sparse depth.

    Args:
        encoder: of one channel, for the sparse depth.
        image_channels: of the image backbone's taps.
        widths: of the decoder's blocks.
        enlarge: how the decoder's maps get their new size.

    Example:
        >>> from deltas_nets.network.paper.resnet import ResNet50
        >>> image, depth = ResNet50(3, width=8), ResNet50(1, width=2)
        >>> densifier = SparseDensifier(depth, image.channels, widths=(16, 8, 8, 4, 4))
        >>> taps, sparse = image(torch.rand(2, 3, 50, 70)), torch.zeros(2, 1, 50, 70)
        >>> [tuple(scale.shape) for scale in densifier(taps, sparse)]
        [(2, 1, 50, 70), (2, 1, 25, 35), (2, 1, 13, 18), (2, 1, 7, 9)]
    """

    def __init__(
        self,
        encoder: Backbone,
        image_channels: TapChannels,
        widths: DecoderWidths = (512, 256, 128, 64, 32),
        *,
        enlarge: Enlarge = enlarge_by_both_axes,
    ) -> None:
        super().__init__()
        self.encoder = encoder
        half, quarter, eighth, sixteenth, deepest = (
            depth + image for depth, image in zip(encoder.channels, image_channels, strict=True)
        )
        joined = (half, quarter, eighth, sixteenth, deepest)
        self.decoder = DepthDecoder(joined, widths, enlarge=enlarge)

    def forward(self, image_taps: Taps, sparse: Tensor) -> DepthScales:
        """Densify.

        Args:
            image_taps: of the anchor.
            sparse: ``(B, 1, H, W)`` metres, 0 where nothing is known.
        """
        return self.decoder.depths(self.maps(image_taps, sparse))

    def maps(self, image_taps: Taps, sparse: Tensor) -> DecoderMaps:
        """What the depths are read from."""
        # Sparse depth is geometry, in float32 at least, and the maps may be of half precision.
        joined = join_taps(image_taps, self.encoder(sparse.to(image_taps.half.dtype)))
        maps: DecoderMaps = self.decoder(joined, image_size=(sparse.shape[-2], sparse.shape[-1]))
        return maps


def join_taps(image: Taps, depth: Taps) -> Taps:
    """Maps of both encoders, one behind the other; the published weights fix the order."""
    half, quarter, eighth, sixteenth, _ = (
        torch.cat([of_depth, of_image], dim=1)
        for of_depth, of_image in zip(depth, image, strict=True)
    )
    deepest = torch.cat([image.deepest, depth.deepest], dim=1)
    return Taps(half, quarter, eighth, sixteenth, deepest)
