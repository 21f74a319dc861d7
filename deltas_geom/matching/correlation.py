"""Dot products of keypoint descriptors with feature maps, read at places of other views.

Correlation comes first and the scalar map is sampled: bilinear reading is linear, so the result
is that of reading D channels and then multiplying, at a fraction of the memory.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from deltas_geom.cameras.pixels import normalizing
from deltas_geom.checks import batch_shape, check_bool, check_shapes, tracing
from deltas_geom.epipolar.sampling import Samples, check_samples
from deltas_geom.matching.lengths import inverse_lengths, length_table
from deltas_geom.numerics.arithmetic import (
    at_least_in_single,
    at_least_single,
    promoted,
    surely_below,
)
from deltas_geom.numerics.evaluation import recomputed

_CACHED_ELEMENTS = 1 << 21  # a chunk should stay in the cache between writing and reading it
_HELD_ELEMENTS = 1 << 28  # where there is no such cache: what one call may hold in memory


@at_least_in_single
def correlate(
    descriptors: Tensor, feature_map: Tensor, samples: Samples, *, image_size: tuple[int, int]
) -> Tensor:
    """Dot products of keypoint descriptors with the sources' features at samples.

    Keeps nothing but its arguments for the backward pass. Arithmetic is in float32 at least,
    whatever ``torch.autocast`` says: half of its digits would move the best place by pixels.

    Args:
        descriptors: ``(*B, N, D)`` of the anchor's keypoints.
        feature_map: ``(*B, V-1, D, h, w)`` of the sources, any stride; beyond the outer centres
            its border is continued.
        samples: places in the sources.
        image_size: (height, width) of the sources' images.

    Returns:
        ``(*B, V-1, N, O, S)``; 0 with zero gradient where the sample is masked, whatever its
        pixel holds; elsewhere a pixel that is NaN counts as one beyond the border. A number of a
        feature that is NaN or infinite counts as 0. ``*B`` broadcasts. At least float32.

    Raises:
        ShapeError, TypeError: a trailing shape differs, a map is empty, the mask is not bool.

    Source: the paper, equation 1.

    Example:
        >>> row = torch.tensor([[1.0, 3.0], [0.0, 4.0]]).reshape(1, 2, 1, 2)  # two pixels, D = 2
        >>> places = torch.tensor([0.0, 0.5, 1.0])[:, None] * torch.tensor([1.0, 0.0])
        >>> samples = Samples(places[None, None, None], torch.ones(1, 1, 3), torch.tensor(True))
        >>> correlate(torch.tensor([[2.0, 1.0]]), row, samples, image_size=(1, 2)).squeeze()
        tensor([ 2.,  6., 10.])
    """
    check_samples(samples)
    check_shapes(
        descriptors=(descriptors, "N D"),
        feature_map=(feature_map, "sources D +h +w"),
        samples=(samples.pixels, "sources N O M 2"),
    )
    check_bool(mask=samples.mask)
    pixels, mask = samples.pixels, samples.mask
    batch = batch_shape(
        (*descriptors.shape[:-2], 1), feature_map.shape[:-3], pixels.shape[:-4], mask.shape[:-3]
    )
    maps, rows = feature_map, descriptors
    finite = surely_below(maps) and surely_below(rows)
    if not finite:
        maps, rows = map(_Finite.apply, (maps, rows))
    return _in_pieces(
        lambda *piece: _DotProducts.apply(*piece, image_size, finite),  # type: ignore[no-untyped-call]
        maps.expand(*batch, *maps.shape[-3:]),
        rows.unsqueeze(-3).expand(*batch, *rows.shape[-2:]),
        pixels.expand(*batch, *pixels.shape[-4:]),
        mask.expand(*batch, *pixels.shape[-4:-1]),
        elements=feature_map.shape[-2:].numel(),
    )


@at_least_in_single
def correlate_normalized(
    descriptors: Tensor, feature_map: Tensor, samples: Samples, *, image_size: tuple[int, int]
) -> Tensor:
    """Dot products with the features brought to unit length *after* they are read.

    Between two pixels a bilinearly read unit feature is shorter than one, the more so the more
    the two differ, which favours pixel centres in :func:`correlate`. With descriptors of unit
    length the result is the cosine of the angle, exactly as if D channels had been read.

    Args:
        descriptors: ``(*B, N, D)`` of the anchor's keypoints.
        feature_map: ``(*B, V-1, D, h, w)`` of the sources, any stride and any lengths.
        samples: places in the sources.
        image_size: (height, width) of the sources' images.

    Returns:
        ``(*B, V-1, N, O, S)``; 0 with zero gradient where the sample is masked, and where
        neighbours cancel to a length below 4 sqrt(eps) of their own.

    Raises:
        ShapeError: a trailing shape differs.

    Example:
        >>> row = torch.tensor([[1.0, 0.0], [0.0, 1.0]]).reshape(1, 2, 1, 2)  # two pixels, D = 2
        >>> between = torch.tensor([0.5, 0.0]).reshape(1, 1, 1, 1, 2)
        >>> samples = Samples(between, torch.ones(1, 1, 1), torch.tensor(True))
        >>> left = torch.tensor([[1.0, 0.0]])
        >>> correlate(left, row, samples, image_size=(1, 2)).item()
        0.5
        >>> round(correlate_normalized(left, row, samples, image_size=(1, 2)).item(), 4)
        0.7071
    """
    dots = correlate(descriptors, feature_map, samples, image_size=image_size)
    (table,) = recomputed(length_table, feature_map)
    batch = batch_shape(feature_map.shape[:-3], samples.pixels.shape[:-4])
    scale = _in_pieces(
        lambda *piece: recomputed(partial(inverse_lengths, image_size=image_size), *piece)[0],
        table.expand(*batch, *table.shape[-3:]),
        samples.pixels.expand(*batch, *samples.pixels.shape[-4:]),
        elements=samples.pixels.shape[-3:-1].numel() * 2 * table.shape[-3],
    )
    return dots * scale


def _in_pieces(
    function: Callable[..., Tensor], maps: Tensor, *keypoints: Tensor, elements: int
) -> Tensor:
    """``function(maps, *keypoints)`` of ``(*B, C, h, w)`` and ``(*B, N, ...)``, ``(*B, N, O, S)``,
    by views and chunks of keypoints, for each of which it holds so many elements.
    """
    if torch.compiler.is_compiling():  # pieces would fix the number of keypoints
        return function(maps, *keypoints)
    batch, dim = maps.shape[:-3], maps.ndim - 3
    held = max(1, batch.numel() * elements)
    limit = _CACHED_ELEMENTS if maps.device.type == "cpu" else _HELD_ELEMENTS
    if keypoints[0].shape[dim] * held <= limit:
        return function(maps, *keypoints)
    # Views before keypoints: each map is then read once, and its gradient is written once.
    if batch.numel() > 1:
        size = limit * batch[0] // (keypoints[0].shape[dim] * held)
        if size > 0:
            groups = zip(*(torch.split(each, size) for each in (maps, *keypoints)), strict=True)
            return torch.cat([function(*group) for group in groups])
    if dim > 0 and batch[0] > 0:
        # unbind and split, not indices: their backward writes every gradient once.
        views = zip(*(tensor.unbind() for tensor in (maps, *keypoints)), strict=True)
        return torch.stack([_in_pieces(function, *view, elements=elements) for view in views])
    chunk = max(16, limit // held)
    chunks = zip(*(torch.split(tensor, chunk, dim=dim) for tensor in keypoints), strict=True)
    return torch.cat([function(maps, *some) for some in chunks], dim=dim)


class _Finite(torch.autograd.Function):
    """The same numbers, without gradient to those that count as 0, and no copy that is kept."""

    generate_vmap_rule = True

    @staticmethod
    def forward(numbers: Tensor) -> Tensor:
        return numbers.view_as(numbers)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (numbers,) = ctx.saved_tensors
        return torch.where(numbers.abs() < torch.inf, gradient, 0.0)


class _DotProducts(torch.autograd.Function):
    """Of features ``(*B, D, h, w)``, descriptors ``(*B, n, D)`` at pixels ``(*B, n, O, S, 2)``.

    0 where ``mask``, ``(*B, n, O, S)``, is False.

    Written out and not left to :func:`recomputed`, because the gradients of both factors need
    no correlation map: a third of the products of the backward pass.
    """

    generate_vmap_rule = True

    @staticmethod
    def forward(
        features: Tensor,
        descriptors: Tensor,
        pixels: Tensor,
        mask: Tensor,
        image_size: tuple[int, int],
        finite: bool,
    ) -> Tensor:
        flat, rows, grid = _in_full(features, descriptors, pixels, image_size, finite)
        maps = (rows @ flat).reshape(-1, 1, *features.shape[-2:])
        read = F.grid_sample(maps, grid, padding_mode="border", align_corners=False)
        return _masked(read.reshape(mask.shape), mask)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        *tensors, ctx.image_size, ctx.finite = inputs
        ctx.save_for_backward(*tensors)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        features, descriptors, pixels, mask = ctx.saved_tensors
        moves = ctx.needs_input_grad[2]
        with torch.autocast(features.device.type, enabled=False):
            options = ctx.image_size, ctx.finite
            flat, rows, grid = _in_full(features, descriptors, pixels, *options)
            count, size = grid.shape[0], features.shape[-2:]
            # Only the gradient of the places reads the values of the maps.
            maps = rows @ flat if moves else rows.new_zeros(()).expand(count, 1, *size)
            of_read = torch.where(mask, gradient, 0.0).reshape(count, 1, *pixels.shape[-3:-1])
            of_maps, of_grid = torch.ops.aten.grid_sampler_2d_backward(
                of_read.contiguous(),
                maps.reshape(count, 1, *size),
                grid,
                interpolation_mode=0,  # bilinear
                padding_mode=1,  # border
                align_corners=False,
                output_mask=[True, moves],
            )
            of_maps = of_maps.reshape(*rows.shape[:-1], flat.shape[-1])
            of_features = (rows.mT @ of_maps).reshape(features.shape).to(features.dtype)
            of_descriptors = (of_maps @ flat.mT).to(descriptors.dtype)
        if not moves:
            return of_features, of_descriptors, None, None, None, None
        slope = normalizing(ctx.image_size, like=of_grid)[1]
        of_pixels = of_grid.reshape(pixels.shape) * slope
        return of_features, of_descriptors, of_pixels.to(pixels.dtype), None, None, None


def _in_full(
    features: Tensor, descriptors: Tensor, pixels: Tensor, image_size: tuple[int, int], finite: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """Features ``(*B, D, h w)``, descriptors, grid ``(*B n, O, S, 2)`` in float32 at least."""
    features, descriptors = promoted(at_least_single(features), descriptors)
    if not finite:  # a NaN would be in all products with it: of a zero gradient, too
        features, descriptors = (x.nan_to_num(0.0, 0.0, 0.0) for x in (features, descriptors))
    pixels = at_least_single(pixels)
    # One pass along rows of x, y, x, y: four, two numbers wide, take as long as the sampling.
    count = pixels.shape[-2]
    shift, slope = (part.repeat(count) for part in normalizing(image_size, like=pixels))
    grid = torch.addcmul(shift, pixels.flatten(-2), slope).to(features.dtype)
    # The backward pass of grid_sample writes out of bounds at NaN (torch 2.13, on the CPU). At
    # the border it has a value and no gradient.
    grid = grid.nan_to_num_(nan=-1.0).reshape(pixels.shape).flatten(0, -4)
    return features.flatten(-2), descriptors, grid


def _masked(values: Tensor, mask: Tensor) -> Tensor:
    """Values in float32 or float64 where the mask is True, elsewhere 0; no derivatives."""
    if torch.compiler.is_compiling() or tracing():
        return torch.where(mask, values, 0.0)
    # Eager, torch.where branches at each number: half the time of the sampling itself. Here all
    # bits of a number are kept, or none.
    bits = torch.int32 if values.dtype == torch.float32 else torch.int64
    return (values.view(bits) & mask.to(bits).neg_()).view(values.dtype)
