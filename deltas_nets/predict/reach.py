"""How near and far depth is searched, and in which unit the network sees the world.

The network was trained on rooms in metres. A capture may have another unit, or be of a desk or a
street: then the network sees it so much larger or smaller that its surfaces are as far as a room's.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from deltas_nets.network.unit import unit_of

__all__ = ["ROOM", "Reach", "end_of_pile", "reach_of", "reach_within", "wider"]

ROOM = (0.5, 10.0)
"""Metres that are searched where nothing says otherwise: what the network was trained with."""
BEYOND = 1.25
"""The search goes on beyond the nearest and the farthest known point by this factor."""
WIDER = 10.0
PILED = (0.05, 0.15)
"""Shares of points at the near and the far end of a search that tell that it was too short. Of good
searches hardly any are there; of rooms that are a fifth as large, searched as rooms, most are at
the near end."""


class Reach(NamedTuple):
    """What is searched.

    Attributes:
        near: nearest depth, in the capture's unit.
        far: farthest depth, in the capture's unit.
        unit: metres that the network takes a unit of the capture for.
    """

    near: float
    far: float
    unit: float = 1.0


def reach_of(depths: ArrayLike, *, metric: bool) -> Reach:
    """A search that finds surfaces at some depths.

    Args:
        depths: ``(D,)`` positive, in the capture's unit; a few may be wrong.
        metric: whether that is the metre.

    Example:
        >>> reach_of([1.5, 2.0, 4.0], metric=True)
        Reach(near=0.5, far=10.0, unit=1.0)
        >>> reach_of([150.0, 200.0, 400.0], metric=False)
        Reach(near=40.0, far=800.0, unit=0.0125)
    """
    nearest, median, farthest = (float(d) for d in np.percentile(np.asarray(depths), (2, 50, 98)))
    unit = unit_of(median, metric)
    near, far = ROOM
    return Reach(min(near / unit, nearest / BEYOND), max(far / unit, farthest * BEYOND), unit)


def reach_within(near: float, far: float, *, metric: bool) -> Reach:
    """A search of all of a range that a capture states, in its unit.

    A narrow one is searched as a room is: depth of three captures without metres is better so, and
    depth in metres does not depend on the format that the capture came in.
    """
    unit = unit_of(2 / (1 / near + 1 / far), metric)
    return Reach(min(ROOM[0] / unit, near), max(ROOM[1] / unit, far), unit)


def end_of_pile(depths: ArrayLike, reach: Reach) -> str | None:
    """Which end of a search found points pile up at, "near" or "far"; None if they do not.

    Args:
        depths: ``(D,)`` of triangulated points, in the capture's unit.
        reach: that was searched.
    """
    found = np.asarray(depths)
    if len(found) and (found < 1.1 * reach.near).mean() > PILED[0]:
        return "near"
    if len(found) and (found > 0.8 * reach.far).mean() > PILED[1]:
        return "far"
    return None


def wider(reach: Reach, end: str) -> Reach:
    """A search that goes on beyond one end."""
    if end == "near":
        return reach._replace(near=reach.near / WIDER)
    return reach._replace(far=reach.far * WIDER)
