"""Feature maps of all views, as an encoder gives them to the later stages."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor


class Features(NamedTuple):
    """Feature maps of B x V images; at stride r the image plane is sampled r times coarser.

    Attributes:
        fine: ``(B, V, C, H/2, W/2)`` straight from the pixels, for exact localisation.
        half: ``(B, V, C, H/2, W/2)``.
        quarter: ``(B, V, C, H/4, W/4)``.
        eighth: ``(B, V, C, H/8, W/8)``.
        sixteenth: ``(B, V, C, H/16, W/16)``.
    """

    fine: Tensor
    half: Tensor
    quarter: Tensor
    eighth: Tensor
    sixteenth: Tensor

    def of_anchor(self) -> "Features":
        """The maps of view 0 alone, ``(B, C, h, w)``."""
        return Features(*(feature[:, 0] for feature in self))

    def each(self) -> list["Features"]:
        """The views one by one, every one with its dim."""
        views = range(self.half.shape[1])
        return [Features(*(feature[:, v : v + 1] for feature in self)) for v in views]

    @staticmethod
    def joined(views: Sequence["Features"]) -> "Features":
        """What :meth:`each` took apart."""
        return Features(*(torch.cat(maps, dim=1) for maps in zip(*views, strict=True)))

    def flat(self) -> "Features":
        """Views as batch: ``(B * V, C, h, w)``."""
        return Features(*(feature.flatten(0, 1) for feature in self))


class Channels(NamedTuple):
    """How many channels each map of :class:`Features` has; the later stages are built for them."""

    fine: int
    half: int
    quarter: int
    eighth: int
    sixteenth: int
