"""Some points at a time, so that what lies between input and output stays in the cache."""

from collections.abc import Callable

import torch
from torch import Tensor

from deltas_geom.recompute import recomputed

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
) -> tuple[Tensor, ...]:
    """``function(cameras, *points)``, keeping only its inputs for backward.

    Args:
        function: from cameras and what is known of points to results, point by point.
        values: the same results by a faster route that need not be differentiable.
        cameras: whole in every chunk.
        points: cut into chunks; the first one tells the number of points.
        dims: along which each result is put together.
    """
    tensors = [tensor for tensor, _ in points]
    # A compiler fuses what lies between instead, and may not know the number of points.
    if torch.compiler.is_compiling():
        return recomputed(function, cameras, *tensors, values=values)
    first, dim = points[0]
    assert first is not None
    chunk = max(_SMALLEST_CHUNK, _CHUNK // max(1, first.shape[: dim - 1].numel()))
    parts = []
    for start in range(0, max(1, first.shape[dim]), chunk):
        some = [
            None if tensor is None else tensor.narrow(d, start, min(chunk, tensor.shape[d] - start))
            for tensor, d in points
        ]
        parts.append(recomputed(function, cameras, *some, values=values))
    if len(parts) == 1:
        return parts[0]
    columns = zip(*parts, strict=True)
    return tuple(torch.cat(column, dim=dim) for dim, column in zip(dims, columns, strict=True))
