"""What an encoder of `deltas-small`'s kind is: a pretrained trunk, and a branch of its own."""

from typing import ClassVar

import torch
from torch import Tensor

from deltas_nets.network.encoder import ImageEncoder
from deltas_nets.network.features import Channels, Features
from deltas_nets.network.layers import ConvBlock


class LiteEncoder(ImageEncoder):
    """RGB images in [0, 1], any size, to :class:`Features`.

    A trunk derives from it, makes ``fine`` last, and gives ``taps``.

    Attributes:
        channels: of its maps.
        fine: the branch that no public weights know, straight from the pixels.
    """

    channels: ClassVar[Channels]
    fine: ConvBlock

    @classmethod
    def fine_branch(cls) -> ConvBlock:
        """A new ``fine``."""
        return ConvBlock(3, cls.channels.fine, stride=2)

    def taps(self, images: Tensor) -> list[Tensor]:
        """Maps of images ``(B * V, 3, H, W)`` at 1/2, 1/4, 1/8 and 1/16, rounded up."""
        raise NotImplementedError

    def forward(self, images: Tensor) -> Features:
        """Encode ``(B, V, 3, H, W)``."""
        flat = images.flatten(0, 1).contiguous(memory_format=torch.channels_last)
        maps = [self.fine(flat), *self.taps(flat)]
        return Features(*(each.unflatten(0, images.shape[:2]) for each in maps))

    def public_names(self) -> dict[str, str]:
        """The trunk has the names of the public checkpoint."""
        return {name: name for name in self.state_dict() if not name.startswith("fine.")}
