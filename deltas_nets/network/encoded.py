"""What the network makes of images one by one, whatever view sets they are in."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch

from deltas_nets.network.features import Features
from deltas_nets.network.lite.descriptor import Descriptors
from deltas_nets.network.paper.paper import ViewTaps


class Encoded(NamedTuple):
    """B x V images encoded.

    Attributes:
        features: for the detector and the densifier, which read the anchor's.
        descriptors: what points are recognised by, in all views.
    """

    features: Features | ViewTaps
    descriptors: Descriptors

    def each(self) -> list["Encoded"]:
        """The views one by one, V of them."""
        views: Sequence[Features | ViewTaps] = self.features.each()
        return [
            Encoded(features, Descriptors(*(part[:, v : v + 1] for part in self.descriptors)))
            for v, features in enumerate(views)
        ]

    @staticmethod
    def joined(views: Sequence["Encoded"]) -> "Encoded":
        """A view set of single views: what :meth:`each` took apart."""
        features: Sequence[Any] = [view.features for view in views]
        descriptors = zip(*(view.descriptors for view in views), strict=True)
        return Encoded(
            type(features[0]).joined(features),
            Descriptors(*(torch.cat(parts, dim=1) for parts in descriptors)),
        )
