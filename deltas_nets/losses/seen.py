"""What a loss may look at, and how it takes a mean."""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_nets.losses.divisors import WHOLE, Divisors
from deltas_nets.losses.targets import Targets
from deltas_nets.network.lite.densifier import DenseDepth
from deltas_nets.network.prediction import DepthPrediction


class MapAlone(NamedTuple):
    """A map that no points come with; the fields are those of :class:`Seen`."""

    dense: DenseDepth
    image: Tensor
    depth: Tensor
    depth_range: tuple[float, float]
    decay: float
    divisors: Divisors = WHOLE


class Seen(NamedTuple):
    """What a term may look at.

    Attributes:
        prediction: of the network, whose poses may have been noisy; its points, and those of the
            targets, are in a world whose origin is where the anchor stands.
        image: ``(B, 3, H, W)`` the anchors as the network saw them.
        depth: ``(B, 1, H, W)`` of the anchors, metres, 0 = unknown.
        targets: truth about the keypoints.
        labels: of the detector: ``(B, ceil(H/8), ceil(W/8))`` channels, or ``(B, 65, ceil(H/8),
            ceil(W/8))`` distributions over them.
        depth_range: as given to the network.
        decay: factor of a dense term from a scale to the next coarser one.
        divisors: of means over places.
    """

    prediction: DepthPrediction
    image: Tensor
    depth: Tensor
    targets: Targets
    labels: Tensor
    depth_range: tuple[float, float]
    decay: float
    divisors: Divisors = WHOLE

    @property
    def dense(self) -> DenseDepth:
        """The dense map at all its scales."""
        return self.prediction.evidence.dense


SeenMap = Seen | MapAlone
"""What a term of the dense map looks at."""


def masked_mean(values: Tensor, mask: Tensor, divisors: Divisors = WHOLE) -> Tensor:
    """Mean of the values where the mask holds; 0 where it holds nowhere."""
    return torch.where(mask, values, 0.0).sum() / divisors.divisor(mask.sum())
