"""What the paper's backbones share: five feature maps, and how images and weights start.

Source: the paper, sections 3.1 and 3.3: the heads read the deepest map and finer ones, the
densifier joins all five with those of the sparse depth.
"""

from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from deltas_nets.network.encoder import Origin

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)


class Taps(NamedTuple):
    """Feature maps of B images; each is half as large as the one before, rounded up.

    Attributes:
        half: ``(B, C, ceil(H/2), ceil(W/2))``.
        quarter: ``(B, C, ceil(H/4), ceil(W/4))``.
        eighth: ``(B, C, ceil(H/8), ceil(W/8))``.
        sixteenth: ``(B, C, ceil(H/16), ceil(W/16))``.
        deepest: ``(B, C, ceil(H/32), ceil(W/32))``.
    """

    half: Tensor
    quarter: Tensor
    eighth: Tensor
    sixteenth: Tensor
    deepest: Tensor

    def of_first(self, count: int) -> "Taps":
        """The maps of the first ``count`` images; batches begin with the anchors."""
        return Taps(*(tap[:count] for tap in self))


TapChannels = tuple[int, int, int, int, int]
"""Channels of each map of :class:`Taps`."""


class Backbone(nn.Module):
    """An encoder of ``(B, inputs, H, W)`` to :class:`Taps`.

    Attributes:
        channels: of its taps, half first.
        origin: the public weights that it can start from.
    """

    channels: TapChannels
    origin: ClassVar[Origin]

    def forward(self, images: Tensor) -> Taps:
        """Encode normalised images, or sparse depth in metres."""
        raise NotImplementedError


def imagenet_normalised(images: Tensor) -> Tensor:
    """RGB ``(..., 3, H, W)`` in [0, 1] by the mean and deviation of ImageNet."""
    # One by one: a tensor of the means would be copied to the device and waited for.
    channels = zip(images.unbind(dim=-3), IMAGENET_MEAN, IMAGENET_STD, strict=True)
    return torch.stack([(channel - mean) / std for channel, mean, std in channels], dim=-3)


def initialise_convolutions(module: nn.Module) -> None:
    """Let all convolutions start with the variance that ReLUs keep on the way back.

    Source: He et al., Delving deep into rectifiers (2015), equation 14.
    """
    for layer in module.modules():
        if isinstance(layer, nn.Conv2d):
            nn.init.kaiming_normal_(layer.weight, mode="fan_out", nonlinearity="relu")
