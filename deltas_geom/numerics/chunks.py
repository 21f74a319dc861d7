"""Some points at a time: so few that what lies between stays in the cache, and no threads start."""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.numerics.sums import SERIAL

_SMALLEST_CHUNK = 512  # points
_IN_CACHE = 4  # views of as many points as start no threads


class Cut(NamedTuple):
    """How a function of many points is computed some points at a time.

    Attributes:
        size: points at a time.
        inputs: for each input the dim, from the end, along which it holds points; 0 if it is whole
            in every chunk.
        outputs: the same of each output.
        values: points at a time where no derivative is computed; None for as many.
    """

    size: int
    inputs: tuple[int, ...]
    outputs: tuple[int, ...]
    values: int | None = None


def cut_points(
    tensor: Tensor, *dims: int, outputs: tuple[int, ...], least: int = 1, serial: bool = False
) -> Cut | None:
    """A cut for cameras and what is known of points, of which ``tensor`` ``(*B, V, N, K)`` tells N.

    Args:
        tensor: along whose second to last dim points lie. So few are taken at a time that no
            operation on all their views starts threads.
        *dims: of the inputs after the cameras.
        outputs: of the outputs.
        least: how many numbers of a point to reckon with where its views are fewer.
        serial: values are computed without operations on all views that could start threads. More
            points are taken at a time then: each time costs as much in calls as 2000 points.
    """
    # A compiler fuses what lies between instead, and may not know the number of points.
    if torch.compiler.is_compiling():
        return None
    # The same however many threads torch may start: a pass costs what it costs with one.
    *batch, views, count, _ = tensor.shape
    places = max(1, math.prod(batch))
    size = max(_SMALLEST_CHUNK, SERIAL // (places * max(views, least, 1)))
    if count <= size:
        return None
    cut = Cut(alike(count, size), (0, *dims), outputs)
    longer = max(size, SERIAL * min(_IN_CACHE, views) // (places * max(views, 1)))
    return cut._replace(values=alike(count, longer)) if serial else cut


def alike(count: int, size: int) -> int:
    """How many of ``count`` points a chunk holds, ``size`` at most.

    All chunks are nearly as long: a small one at the end would cost as many calls as a whole one.
    """
    return max(1, -(-count // max(1, -(-count // size))))


def chunks(
    cut: Cut, tensors: Sequence[Tensor | None], dims: Sequence[int]
) -> Iterator[tuple[Tensor | None, ...]]:
    """The tensors of each chunk."""
    count = next(t.shape[d] for t, d in zip(tensors, dims, strict=True) if t is not None and d)
    for start in range(0, max(1, count), cut.size):
        yield tuple(
            t if t is None or d == 0 else t.narrow(d, start, min(cut.size, count - start))
            for t, d in zip(tensors, dims, strict=True)
        )


def joined(parts: Sequence[Tensor], dim: int) -> Tensor:
    """The parts as one tensor, copied in pieces for which no threads are started."""
    if len(parts) == 1:
        return parts[0]
    few = max(1, SERIAL * parts[0].shape[dim] // max(1, parts[0].numel()))
    if few < parts[0].shape[dim]:
        parts = [piece for part in parts for piece in torch.split(part, few, dim)]
    return torch.cat(list(parts), dim)
