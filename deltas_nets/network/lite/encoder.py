"""What an encoder of `deltas-small`'s kind is: a pretrained trunk, and a branch of its own."""

from typing import ClassVar, Self

import torch
from torch import Tensor

from deltas_nets.network.encoder import ImageEncoder
from deltas_nets.network.features import Channels, Features
from deltas_nets.network.layers import ConvBlock

STRIDES = (2, 2, 4, 8, 16)
"""Of the maps of :class:`Features`."""


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
    def whole(cls) -> Self:
        """A new one that states all that other stages and training ask for.

        Raises:
            TypeError: it does not.
        """
        cls._check_stated(cls, channels="channels = Channels(...)", origin="origin = Origin(...)")
        encoder = cls()
        cls._check_stated(encoder, fine="self.fine = self.fine_branch(), last in __init__")
        return encoder

    @classmethod
    def _check_stated(cls, stating: object, **lines: str) -> None:
        for name, line in lines.items():
            if not hasattr(stating, name):
                raise TypeError(f"the encoder {cls.__name__} has no {name}: write {line}")

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
        self._check(maps, (images.shape[-2], images.shape[-1]))
        return Features(*(each.unflatten(0, images.shape[:2]) for each in maps))

    def _check(self, maps: list[Tensor], image_size: tuple[int, int]) -> None:
        """Whether maps are those that the other stages are built for.

        Raises:
            ValueError: too few or many of them, or one of other channels or another size.
        """
        who = type(self).__name__
        if len(maps) != len(STRIDES):
            taps = len(STRIDES) - 1
            raise ValueError(
                f"{who}.taps must give {taps} maps, at 1/2 to 1/16, got {len(maps) - 1}"
            )
        for (name, channels), stride, found in zip(
            self.channels._asdict().items(), STRIDES, maps, strict=True
        ):
            wanted = (channels, *(-(-side // stride) for side in image_size))
            if found.shape[1:] != wanted:
                shape = f"(C, H, W) {tuple(found.shape[1:])} instead of {wanted}"
                raise ValueError(
                    f"{who} gives the map {name} {shape}: see its channels and strides"
                )

    def public_names(self) -> dict[str, str]:
        """The trunk has the names of the public checkpoint."""
        return {name: name for name in self.state_dict() if not name.startswith("fine.")}
