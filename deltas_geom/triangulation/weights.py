"""How much each view counts for each point, and which count at all."""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.numerics.arithmetic import only, solver_dtype, values_at_hand

NEGLIGIBLE_WEIGHT = 1e-6
"""A view whose weight is below this share of the point's largest counts as no view: its squared
weight, times a small parallax, would be lost in the rounding of the normal matrix."""


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
    # What is not sound makes its point fail, if it is used: it need not be told from point to
    # point where all are alike.
    squared, largest, unused, counted = _shares(weight, largest, None if alike else sound)
    known = counted if sound is None else (sound | unused) & counted
    return Weights(squared, largest, unused, (~unused).to(work), known.all(dim=-2))


def _all_one(one: Tensor) -> Weights:
    """Of views ``(*B, V, 1)`` that all count, and as much."""
    none = torch.zeros_like(one, dtype=torch.bool)
    return Weights(one, one[..., :1, :], none, one, ~none[..., 0, :])


def weigh_listed(weights: Tensor, point: Tensor, count: int, *, sound: Tensor) -> Weights:
    """The same of a list of observations, all fields ``(T)`` but ``sound`` and ``largest`` ``(N)``.

    Args:
        weights: ``(T)``, in the solver's type.
        point: ``(T)`` index of each observation's point.
        count: N.
        sound: ``(T)`` bool.
    """
    size = weights.detach().abs()
    sound = sound & (size <= torch.finfo(size.dtype).max)  # NaN is not
    largest = size.new_zeros(count).scatter_reduce(0, point, size.nan_to_num(0.0), "amax")
    squared, _, unused, _ = _shares(weights, largest.index_select(0, point), sound)
    wrong = size.new_zeros(count).index_add(0, point, (~(sound | unused)).to(size.dtype))
    largest = torch.where(largest > 0, largest, 1.0)
    return Weights(squared, largest, unused, (~unused).to(size.dtype), wrong == 0)


def _shares(
    weight: Tensor, largest: Tensor, sound: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Squared shares of the largest, 0 unless used and sound; the largest, or 1 if that is no
    number to divide by; what is unused; is the largest finite?
    """
    unused = weight.detach().abs() <= NEGLIGIBLE_WEIGHT * largest
    counted = largest <= torch.finfo(largest.dtype).max  # NaN is not, either
    largest = torch.where(counted & (largest > 0), largest, 1.0)
    # Double where: an infinite weight must not turn the gradient into NaN.
    share = only(weight, counted, sound) / largest
    return only(share * share, ~unused, sound), largest, unused, counted


def _all_count(size: Tensor, largest: Tensor) -> bool:
    """Is every weight finite and used, where that may be asked?"""
    return (
        values_at_hand(size)
        and size.numel() > 0
        and bool((size / largest).amin() > NEGLIGIBLE_WEIGHT)  # inf / inf is not
    )
