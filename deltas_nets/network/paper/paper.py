"""The paper's stages around its backbones, in the shapes that :class:`Deltas` composes.

Where the reference network departs from the paper the paper is followed; what the weights of its
authors need is in :mod:`deltas_nets.reference`.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from deltas_geom import SparseDepth
from deltas_geom.numerics.arithmetic import at_least_single
from deltas_nets.config import DetectorConfig
from deltas_nets.network.encoder import ImageEncoder
from deltas_nets.network.lite.calibration import SpreadCalibration
from deltas_nets.network.lite.densifier import DenseDepth
from deltas_nets.network.lite.descriptor import Descriptors
from deltas_nets.network.lite.detector import Keypoints, choose_keypoints
from deltas_nets.network.paper.sparse_densifier import DecoderWidths, SparseDensifier
from deltas_nets.network.paper.superpoint_head import DescriptorHead, DetectorHead
from deltas_nets.network.paper.taps import Backbone, TapChannels, Taps, imagenet_normalised

TYPICAL_DEPTH = 2.5
"""What an untrained densifier predicts, metres."""


class ViewTaps(NamedTuple):
    """Taps of B x V images.

    Attributes:
        taps: of all images, views of an anchor one after the other.
        num_views: V.
        image_size: (height, width).
    """

    taps: Taps
    num_views: int
    image_size: tuple[int, int]

    def of_anchor(self) -> Taps:
        """The taps of view 0, ``(B, C, h, w)``."""
        return Taps(*(tap[:: self.num_views] for tap in self.taps))

    def each(self) -> list["ViewTaps"]:
        """The views one by one."""
        return [
            self._replace(taps=Taps(*(tap[v :: self.num_views] for tap in self.taps)), num_views=1)
            for v in range(self.num_views)
        ]

    @staticmethod
    def joined(views: Sequence["ViewTaps"]) -> "ViewTaps":
        """What :meth:`each` took apart."""
        taps = zip(*(view.taps for view in views), strict=True)
        together = Taps(*(torch.stack(maps, dim=1).flatten(0, 1) for maps in taps))
        return views[0]._replace(taps=together, num_views=len(views))


class PaperEncoder(ImageEncoder):
    """RGB images in [0, 1] to the backbone's taps."""

    def __init__(self, backbone: Backbone) -> None:
        super().__init__()
        self.backbone = backbone
        self.origin = backbone.origin

    def forward(self, images: Tensor) -> ViewTaps:
        """Encode ``(B, V, 3, H, W)``."""
        flat = imagenet_normalised(images.flatten(0, 1))
        flat = flat.contiguous(memory_format=torch.channels_last)
        size = (images.shape[-2], images.shape[-1])
        return ViewTaps(self.backbone(flat), images.shape[1], size)

    def public_names(self) -> dict[str, str]:
        """The backbone has the names of its public checkpoint."""
        return {name: f"backbone.{name}" for name in self.backbone.state_dict()}


class PaperDetector(nn.Module):
    """Interest points of the anchor from the deepest tap (paper, section 3.1)."""

    def __init__(self, config: DetectorConfig, channels: TapChannels, width: int) -> None:
        super().__init__()
        self.config = config
        self.head = DetectorHead(channels, width)

    def forward(
        self,
        features: ViewTaps,
        *,
        image_size: tuple[int, int],
        num_keypoints: int | None = None,
        shift: Tensor | None = None,
    ) -> Keypoints:
        """See :class:`deltas_nets.network.lite.detector.Detector`."""
        logits = self.head(features.of_anchor(), image_size=image_size).logits
        return choose_keypoints(
            at_least_single(logits),
            self.config,
            image_size=image_size,
            num_keypoints=num_keypoints,
            shift=shift,
        )


class PaperDescriptor(nn.Module):
    """Descriptors at 1/8 of every view (paper, section 3.1)."""

    def __init__(self, channels: TapChannels, dim: int, width: int) -> None:
        super().__init__()
        self.head = DescriptorHead(channels, dim, width)

    def forward(self, features: ViewTaps) -> Descriptors:
        """Descriptors of all views; no context, the per-view matcher reads none."""
        unit = self.head(features.taps, image_size=features.image_size).unit
        maps = at_least_single(unit.unflatten(0, (-1, features.num_views)))
        return Descriptors(maps, maps[:, :, :0])


class PaperDensifier(nn.Module):
    """Sparse encoder, joined with the image's, and one decoder (paper, section 3.3).

    The decoder predicts log depth, which nothing needs to keep positive, and the spread of its
    error, which the paper has not.
    """

    def __init__(self, encoder: Backbone, channels: TapChannels, widths: DecoderWidths) -> None:
        super().__init__()
        self.net = SparseDensifier(encoder, channels, widths)
        decoder = self.net.decoder
        for scale in (
            decoder.conv_final,
            decoder.conv_scale2,
            decoder.conv_scale4,
            decoder.conv_scale8,
        ):
            nn.init.normal_(scale.weight, std=0.01)
            nn.init.constant_(scale.bias, math.log(TYPICAL_DEPTH))  # type: ignore[arg-type]
        self.spread = nn.Conv2d(widths[3], 1, 1)
        self.calibration = SpreadCalibration()

    def forward(self, features: ViewTaps, sparse: SparseDepth) -> DenseDepth:
        """Densify ``(B, 1, H, W)`` sparse depth of the anchor."""
        maps = self.net.maps(features.of_anchor(), sparse.depth)
        depths = (at_least_single(depth) for depth in self.net.decoder.depths(maps))
        return DenseDepth(tuple(depths), at_least_single(self.spread(maps.half)).clamp(-6, 2))
