"""What :mod:`weights` tells of views, of values at hand: in NumPy, which starts no threads."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deltas_geom.triangulation.weights import NEGLIGIBLE_WEIGHT

Array = NDArray[Any]
_LIMIT = float(np.finfo(np.float64).max)


class Weighed(NamedTuple):
    """Pixels, and how much each view counts for each point.

    Arrays may have 1 in place of N where all points are alike.

    Attributes:
        pixels: float64, 0 where not finite.
        share: weights by each point's largest, 0 where unused or not finite.
        largest: that; 1 if it is 0.
        used: bool.
        sound: bool, without the views' axis: every used pixel and weight is finite.
    """

    pixels: Array
    share: Array
    largest: Array
    used: Array
    sound: Array


def weigh_at_hand(
    pixels: Array,
    weights: Array | None,
    mask: Array | None,
    ones: Array,
    *,
    coordinates: int,
    views: int,
) -> Weighed:
    """Tell used views from unused ones.

    Args:
        pixels: float64, in any order of axes; those of unused views may hold anything.
        weights: in the order of the pixels, without coordinates. 0 = unused; the sign has no
            effect. NaN counts as used.
        mask: likewise, True = used.
        ones: the weights that stand for none.
        coordinates: the axis of x and y.
        views: the axis of views, without coordinates.
    """
    limit = _LIMIT**0.125  # squares of what is beyond overflow
    finite = None
    if not (-limit < pixels.min() and pixels.max() < limit):  # NaN is not
        finite = np.abs(pixels).max(axis=coordinates) < limit
    if weights is None and mask is None:
        size = ones
    else:
        size = np.abs((np.ones(()) if weights is None else weights).astype(np.float64))
        if mask is not None:
            size = np.where(mask, size, 0.0)
    largest = size.max(axis=views, keepdims=True)
    share = size / largest
    if finite is None and share.min() > NEGLIGIBLE_WEIGHT:  # inf / inf is not
        every = np.ones_like(ones, dtype=bool)
        return Weighed(pixels, share, largest, every, np.all(every, axis=views))
    used = ~(size <= NEGLIGIBLE_WEIGHT * largest)
    counted = largest <= _LIMIT  # NaN is not, either
    largest = np.where(counted & (largest > 0), largest, 1.0)
    share = np.where(used & counted, size / largest, 0.0)
    sound = counted.squeeze(axis=views)
    if finite is not None:
        share = np.where(finite, share, 0.0)
        sound = (finite | ~used).all(axis=views) & sound
        pixels = np.where(np.expand_dims(finite, coordinates), pixels, 0.0)
    return Weighed(pixels, share, largest, used, sound)
