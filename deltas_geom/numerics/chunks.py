"""Some points at a time, so that what lies between input and output stays in the cache."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from deltas_geom.numerics.evaluation import recomputed

_CHUNK, _SMALLEST_CHUNK = 16384, 1024  # points

Sliced = tuple[tuple[Tensor | None, int], ...]
"""Tensors and the dim along which each holds points."""


def in_chunks(
    function: Callable[..., tuple[Tensor, ...]],
    values: Callable[..., tuple[Tensor, ...]],
    cameras: Tensor,
    points: Sliced,
    *,
    dims: tuple[int, ...],
    prepare: Callable[[Tensor], Any] | None = None,
) -> tuple[Tensor, ...]:
    """``function(cameras, *points)``, keeping only its inputs for backward.

    Args:
        function: from cameras and what is known of points to results, point by point.
        values: the same results by a faster route that need not be differentiable.
        cameras: whole in every chunk.
        points: cut into chunks; the first one tells the number of points.
        dims: along which each result is put together.
        prepare: what ``values`` takes in place of ``cameras``: computed once, not in every chunk.
    """
    tensors = [tensor for tensor, _ in points]
    # A compiler fuses what lies between instead, and may not know the number of points.
    if torch.compiler.is_compiling():
        if prepare is not None:
            values = _prepared(values, prepare)
        return recomputed(function, cameras, *tensors, values=values)
    if prepare is not None:
        with torch.no_grad():
            values = _replaced(values, prepare(cameras))
    first, dim = points[0]
    assert first is not None
    count = first.shape[dim]
    chunk = max(_SMALLEST_CHUNK, _CHUNK // max(1, first.shape[: dim - 1].numel()))
    # All alike: a small one at the end would cost as many calls as a whole one.
    chunk = max(1, -(-count // max(1, round(count / chunk))))
    parts = []
    for start in range(0, max(1, count), chunk):
        some = [
            None if tensor is None else tensor.narrow(d, start, min(chunk, tensor.shape[d] - start))
            for tensor, d in points
        ]
        parts.append(recomputed(function, cameras, *some, values=values))
    if len(parts) == 1:
        return parts[0]
    columns = zip(*parts, strict=True)
    return tuple(torch.cat(column, dim=dim) for dim, column in zip(dims, columns, strict=True))


def _prepared(
    values: Callable[..., tuple[Tensor, ...]], prepare: Callable[[Tensor], Any]
) -> Callable[..., tuple[Tensor, ...]]:
    return lambda cameras, *points: values(prepare(cameras), *points)


def _replaced(
    values: Callable[..., tuple[Tensor, ...]], known: Any
) -> Callable[..., tuple[Tensor, ...]]:
    return lambda _, *points: values(known, *points)


def surely_all(mask: Tensor) -> bool:
    """Whether all is true, where that may be asked at no cost; elsewhere False.

    What holds for all points need not be told from point to point.
    """
    return values_at_hand(mask) and bool(mask.all())


def values_at_hand(tensor: Tensor) -> bool:
    """May what is computed depend on values: nobody traces it, and no other device has them?"""
    if torch.compiler.is_compiling() or torch.jit.is_tracing():  # type: ignore[no-untyped-call,attr-defined]
        return False
    if torch._C._are_functorch_transforms_active():
        return False
    return type(tensor) is Tensor and tensor.device.type == "cpu"
