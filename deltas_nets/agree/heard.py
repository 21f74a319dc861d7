"""Depth maps that an anchor hears, and where they are seen from."""

from typing import NamedTuple

from deltas_geom import PosedViews
from deltas_nets.network.known_depth import KnownDepth


class Heard(NamedTuple):
    """Maps of one size.

    Attributes:
        maps: ``(V, 1, H, W)``.
        views: their cameras, ``(V)``.
    """

    maps: KnownDepth
    views: PosedViews
