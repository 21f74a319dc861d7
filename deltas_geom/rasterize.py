"""Sparse depth images from points: which pixel they fall on, and who wins."""

from typing import Literal

import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import safe_divide
from deltas_geom.checks import check_batch, check_image_size
from deltas_geom.numerics.arithmetic import finite_or_zero, only, promoted, without_autocast
from deltas_geom.records import Record


class SparseDepth(Record):
    """A depth image that is mostly empty.

    Attributes:
        depth: ``(*B, 1, H, W)`` metres; 0 where the weight is 0.
        weight: ``(*B, 1, H, W)`` not negative; 0 where there is no point.
    """

    depth: Tensor
    weight: Tensor


def check_drawing(reduce: str, splat: str) -> None:
    """Raise ``ValueError`` unless both are known to :func:`rasterize_depth`."""
    if reduce not in ("front", "mean"):
        raise ValueError(f"reduce must be 'front' or 'mean', got {reduce!r}")
    if splat not in ("pixel", "bilinear"):
        raise ValueError(f"splat must be 'pixel' or 'bilinear', got {splat!r}")


@without_autocast
def rasterize_depth(
    pixels: Tensor,
    depth: Tensor,
    *,
    image_size: tuple[int, int],
    mask: Tensor | None = None,
    weights: Tensor | None = None,
    reduce: Literal["front", "mean"] = "front",
    splat: Literal["pixel", "bilinear"] = "pixel",
) -> SparseDepth:
    """Write the depth of points into an image, in whatever order they come.

    Args:
        pixels: ``(*B, N, 2)``; points outside the image are ignored.
        depth: ``(*B, N)`` metres; points that are not finite or not positive are ignored.
        image_size: (height, width).
        mask: ``(*B, N)`` bool, True = used.
        weights: ``(*B, N)`` not negative, for example inverse variances; 1 without them.
        reduce: where points share a pixel, the nearest wins ("front"; ties go to the first),
            or the weighted mean and the sum of weights are kept ("mean").
        splat: a point goes to the nearest pixel, or to its four neighbours with bilinear
            shares of its weight.

    Returns:
        Depth, differentiable in ``depth`` and ``weights`` (and in ``pixels`` for the weight
        of bilinear splats), and weight.

    Raises:
        ShapeError: a trailing shape differs, or batch dims do not broadcast.
        TypeError: the mask is not bool, what should be real numbers are integers or no tensor, or
            the size is in floats.
        ValueError: unknown reduce or splat, or an image without pixels.

    Source: the paper, section 3.3.

    Example:
        >>> rasterize_depth(
        ...     torch.tensor([[0.0, 0.0], [0.2, 0.0]]), torch.tensor([3.0, 2.0]), image_size=(1, 2)
        ... ).depth
        tensor([[[2., 0.]]])
    """
    check_drawing(reduce, splat)
    check_image_size(image_size)
    batch = check_batch(
        pixels=(pixels, "N 2"), depth=(depth, "N"), mask=(mask, "N"), weights=(weights, "N")
    )
    given = torch.ones_like(depth) if weights is None else weights
    pixels, depth, given = promoted(pixels, depth, given)
    # Double where: what is not used must pass no gradient and no NaN.
    pixels, known = finite_or_zero(pixels)
    used = (depth > 0) & (depth < torch.inf) & (given > 0) & (given < torch.inf)
    used = only(used, mask, None if known is None else known[..., 0], other=False)
    pixels = pixels.expand(*batch, *pixels.shape[-2:])
    depth = torch.where(used, depth, 0.0)
    shares, columns, rows = _footprint(pixels, splat)
    weight = torch.where(used, given, 0.0)[..., None] * shares

    height, width = image_size
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    weight = torch.where(inside, weight, 0.0).flatten(-2)
    depth = depth[..., None].expand(shares.shape).flatten(-2)
    index = (rows.clamp(0, height - 1) * width + columns.clamp(0, width - 1)).flatten(-2)
    flat = _front if reduce == "front" else _mean
    image_depth, image_weight = flat(index, depth, weight, height * width)
    shape = (*batch, 1, height, width)
    return SparseDepth(image_depth.reshape(shape), image_weight.reshape(shape))


def _footprint(pixels: Tensor, splat: str) -> tuple[Tensor, Tensor, Tensor]:
    """Shares, columns and rows ``(*B, N, 1 or 4)`` of the pixels each point falls on."""
    if splat == "pixel":
        # floor(x + 0.5), not round: a pixel owns [-0.5, 0.5) around its centre.
        cell = (pixels + 0.5).floor().long()
        return torch.ones_like(pixels[..., :1]), cell[..., :1], cell[..., 1:]
    corner = pixels.floor()
    x, y = (pixels - corner).unbind(dim=-1)
    shares = torch.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], dim=-1)
    # Less than rounding of the whole is no share: a mean over it alone has gradients without bound.
    shares = torch.where(shares > torch.finfo(shares.dtype).eps, shares, 0.0)
    column, row = corner.long().unbind(dim=-1)
    columns = torch.stack([column, column + 1, column, column + 1], dim=-1)
    rows = torch.stack([row, row, row + 1, row + 1], dim=-1)
    return shares, columns, rows


def _mean(index: Tensor, depth: Tensor, weight: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Weighted mean depth and summed weight of each pixel, which ends at the largest number."""
    empty = torch.zeros(*index.shape[:-1], size, dtype=depth.dtype, device=depth.device)
    limits = torch.finfo(weight.dtype)
    total = empty.scatter_add(-1, index, weight).clamp_max(limits.max)
    # As parts of the pixel's largest, which cancels: sums of weights can overflow, and vanish.
    most = empty.scatter_reduce(-1, index, weight.detach(), reduce="amax").gather(-1, index)
    # Of subnormal weights gradients would be infinite.
    changing = torch.where(most > limits.tiny, weight, weight.detach())
    parts = changing / most.clamp_min(limits.tiny)
    whole = empty.scatter_add(-1, index, parts).gather(-1, index)
    # Shares before the sum: weight times depth could overflow where the mean does not.
    share = safe_divide(parts, whole, whole > 0)
    return empty.scatter_add(-1, index, share * depth), total


def _front(index: Tensor, depth: Tensor, weight: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Depth and weight of the nearest point of each pixel."""
    # Two minima, of depth and then of number among the nearest, do not depend on the order in
    # which a device writes, and are exact in every dtype.
    falls = weight > 0
    key = torch.where(falls, depth.detach(), torch.inf)
    nearest = depth.new_full((*index.shape[:-1], size), torch.inf)
    nearest = nearest.scatter_reduce(-1, index, key, reduce="amin")
    wins = falls & (key == nearest.gather(-1, index))
    count = index.shape[-1]
    number = torch.arange(count, device=index.device).expand(index.shape)
    first = torch.full_like(nearest, count, dtype=torch.int64)
    first = first.scatter_reduce(-1, index, torch.where(wins, number, count), reduce="amin")
    wins = wins & (number == first.gather(-1, index))
    # One point of a pixel wins, so that a sum is what it has. Points are few, pixels many: to look
    # up each pixel's winner takes twice as long.
    empty = torch.zeros_like(nearest)
    taken_depth, taken_weight = (
        empty.scatter_add(-1, index, torch.where(wins, value, 0.0)) for value in (depth, weight)
    )
    return taken_depth, taken_weight
