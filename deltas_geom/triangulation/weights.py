"""How much each view counts for each point, and which count at all.

Of tensors, by what torch derives and traces; of values at hand in NumPy, which starts no threads.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from deltas_geom.numerics.arithmetic import only, solver_dtype, values_at_hand
from deltas_geom.numerics.vectors import Array, Numbers

NEGLIGIBLE_WEIGHT = 1e-6
"""A view whose weight is below this share of the point's largest counts as no view: its squared
weight, times a small parallax, would be lost in the rounding of the normal matrix."""
_FARTHEST = float(np.finfo(np.float64).max) ** 0.125  # px: squares of what is beyond overflow


class Weights(NamedTuple):
    """How much each view counts for each point.

    The second to last dims are V; the last one is 1 where all points are alike.

    Attributes:
        squared: ``(*B, V, N)`` squared weights, a point's largest 1; 0 where unused. 0 or
            anything where unsound, which makes the point fail.
        largest: ``(*B, 1, N)`` a point's largest weight; 1 if that is 0.
        unused: ``(*B, V, N)`` bool.
        used: ``(*B, V, N)`` its complement as 1 and 0, to be summed.
        sound: ``(*B, N)`` bool: every used weight is finite, and what it weighs is sound.
    """

    squared: Tensor
    largest: Tensor
    unused: Tensor
    used: Tensor
    sound: Tensor


def weigh(
    weights: Tensor | None,
    mask: Tensor | None,
    *,
    batch: torch.Size,
    like: Tensor,
    sound: Tensor | None,
) -> Weights:
    """Tell used views from unused ones.

    Args:
        weights: ``(*B, V, N)`` or None for all 1. 0 = unused; the sign has no effect. NaN counts
            as used.
        mask: ``(*B, V, N)`` bool or None, True = used.
        batch: dims to which all are expanded.
        like: ``(*B, V, N, ...)`` of what is weighed.
        sound: ``(*B, V, N)`` bool: it can be used; None where everything can.
    """
    views, work = like.shape[-3], solver_dtype(like)
    alike = weights is None and mask is None
    if alike and sound is None:
        return _all_one(like.new_ones((*batch, views, 1), dtype=work))
    weight = like.new_ones((), dtype=work) if weights is None else weights.to(work)
    if mask is not None:
        weight = torch.where(mask, weight, 0.0)
    weight = weight.expand(*batch, views, 1 if alike else like.shape[-2])
    size = weight.detach().abs()
    largest = size.amax(dim=-2, keepdim=True)
    if sound is None and _all_count(size, largest):
        share = weight / largest
        return _all_one(size.new_ones((*batch, views, 1)))._replace(
            squared=share * share, largest=largest
        )
    share, largest, unused, counted = _shares(weight, size, largest, torch.where)
    known = counted if sound is None else (sound | unused) & counted
    return Weights(share * share, largest, unused, (~unused).to(work), known.all(dim=-2))


def _all_one(one: Tensor) -> Weights:
    """Of views ``(*B, V, 1)`` that all count, and as much."""
    none = torch.zeros_like(one, dtype=torch.bool)
    return Weights(one, one[..., :1, :], none, one, ~none[..., 0, :])


def _all_count(size: Tensor, largest: Tensor) -> bool:
    """Is every weight finite and used, where that may be asked?"""
    return (
        values_at_hand(size)
        and size.numel() > 0
        and bool((size / largest).amin() > NEGLIGIBLE_WEIGHT)  # inf / inf is not
    )


def _shares(
    weight: Numbers, size: Numbers, largest: Numbers, where: Callable[..., Numbers]
) -> tuple[Numbers, Numbers, Numbers, Numbers]:
    """Shares of the largest weight, 0 unless used and finite; the largest, or 1 if that is no
    number to divide by; what is unused; is the largest finite? Of tensors or arrays.
    """
    unused = size <= NEGLIGIBLE_WEIGHT * largest
    counted = largest < math.inf  # NaN is not, either
    largest = where(counted & (largest > 0), largest, 1.0)
    # Double where: an infinite weight must not turn the gradient into NaN.
    return where(counted & ~unused, weight, 0.0) / largest, largest, unused, counted


def weigh_listed(weights: Tensor, point: Tensor, count: int, *, sound: Tensor) -> Weights:
    """The same of a list of observations ``(T)`` of N points, whose index is ``point``.

    All fields are ``(T)`` but ``sound`` and ``largest`` ``(N)``.
    """
    size = weights.detach().abs()
    sound = sound & (size < math.inf)  # NaN is not
    largest = size.new_zeros(count).scatter_reduce(0, point, size.nan_to_num(0.0), "amax")
    of_each = largest.index_select(0, point)
    share, _, unused, _ = _shares(only(weights, sound), size, of_each, torch.where)
    wrong = size.new_zeros(count).index_add(0, point, (~(sound | unused)).to(size.dtype))
    largest = torch.where(largest > 0, largest, 1.0)
    return Weights(share * share, largest, unused, (~unused).to(size.dtype), wrong == 0)


class Weighed(NamedTuple):
    """Pixels, and how much each view counts for each point, at hand.

    Arrays may have 1 in place of N where all points are alike.

    Attributes:
        pixels: float64, 0 where not finite.
        share: weights by each point's largest, 0 where unused.
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
    """As :func:`weigh`, in any order of axes, and which pixels are finite.

    ``ones`` are the weights that stand for none. x and y are along the axis ``coordinates``; the
    axis of views is counted without it.
    """
    finite = None
    if not (pixels.min() > -_FARTHEST and pixels.max() < _FARTHEST):  # NaN is not
        finite = np.abs(pixels).max(axis=coordinates) < _FARTHEST
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
    share, largest, unused, counted = _shares(size, size, largest, np.where)
    used, sound = ~unused, counted.squeeze(axis=views)
    if finite is not None:
        sound = (finite | unused).all(axis=views) & sound
        pixels = np.where(np.expand_dims(finite, coordinates), pixels, 0.0)
    return Weighed(pixels, share, largest, used, sound)
