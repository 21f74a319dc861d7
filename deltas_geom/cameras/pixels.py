"""The pixel convention: (x, y), pixel centres at integers, image spans [-0.5, W - 0.5].

Everything that knows how a pixel becomes a `grid_sample` coordinate, a pixel of a resized
or cropped image, or a place in a feature map is here and nowhere else.
"""

from functools import lru_cache

import torch
import torch.nn.functional as F
from torch import Tensor

from deltas_geom.checks import batch_shape, check_image_size, check_shapes
from deltas_geom.numerics.arithmetic import numbers_or_zero, values_at_hand, without_autocast
from deltas_geom.numerics.vectors import matrix3


def pixel_grid(
    image_size: tuple[int, int],
    *,
    device: torch.device | str | None = None,
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Centres of all pixels in raster order, ``(H * W, 2)``.

    Example:
        >>> pixel_grid((1, 2))
        tensor([[0., 0.],
                [1., 0.]])
    """
    check_image_size(image_size)
    height, width = image_size
    y, x = torch.meshgrid(
        torch.arange(height, device=device, dtype=dtype),
        torch.arange(width, device=device, dtype=dtype),
        indexing="ij",
    )
    return torch.stack([x, y], dim=-1).reshape(-1, 2)


@without_autocast
def in_image(pixels: Tensor, *, image_size: tuple[int, int], border: float = 0.0) -> Tensor:
    """Whether pixels ``(*B, 2)`` lie in the image, at least ``border`` px from its edge; not NaN.

    Returns:
        ``(*B)`` bool.
    """
    check_shapes(pixels=(pixels, "2"))
    check_image_size(image_size)
    height, width = image_size
    x, y = pixels.unbind(dim=-1)
    low = border - 0.5
    return (x >= low) & (x <= width - 1 - low) & (y >= low) & (y <= height - 1 - low)


@without_autocast
def normalize_pixels(pixels: Tensor, *, image_size: tuple[int, int]) -> Tensor:
    """Pixels ``(*B, 2)`` as `grid_sample` coordinates (``align_corners=False``).

    The image spans [-1, 1] whatever its resolution, so the same coordinates read a feature
    map of any stride: pixel p lies at (p + 0.5) / stride - 0.5 of the map. A coordinate that is
    NaN or infinite is the border, NaN and minus infinity the left or upper one, without gradient:
    the backward pass of grid_sample writes out of bounds at NaN (torch 2.13, on the CPU).

    Example:
        >>> normalize_pixels(torch.tensor([-0.5, 1.5]), image_size=(2, 4))
        tensor([-1.,  1.])
    """
    check_shapes(pixels=(pixels, "2"))
    at_zero, slope = normalizing(image_size, like=pixels)
    grid = torch.addcmul(at_zero, pixels, slope)
    return grid.nan_to_num_(nan=-1.0, posinf=1.0, neginf=-1.0)


def read_map(
    maps: Tensor, pixels: Tensor, *, image_size: tuple[int, int], mode: str = "bilinear"
) -> Tensor:
    """``(*B, D, N)`` of maps ``(*B, D, h, w)`` of any stride at pixels ``(*B, N, 2)``.

    Beyond the outer centres the border is continued. A number that is not finite counts as 0.
    """
    batch = batch_shape(maps.shape[:-3], pixels.shape[:-2])
    # The count, not -1: a reshape of nothing cannot infer it.
    count, size, num = batch.numel(), maps.shape[-3:], pixels.shape[-2]
    maps = numbers_or_zero(maps).expand(*batch, *size).reshape(count, *size)
    grid = normalize_pixels(pixels, image_size=image_size).to(maps.dtype)
    grid = grid.expand(*batch, num, 2).reshape(count, 1, num, 2)
    read = F.grid_sample(maps, grid, mode, padding_mode="border", align_corners=False)
    return read.reshape(*batch, size[0], num)


def normalizing(image_size: tuple[int, int], *, like: Tensor) -> tuple[Tensor, Tensor]:
    """What :func:`normalize_pixels` gives to pixel (0, 0), and its slope, each ``(2,)``."""
    check_image_size(image_size)
    # What a mode of torch makes, as a fake tensor, is not to be kept.
    if values_at_hand(like) and torch._C._len_torch_dispatch_stack() == 0:
        return _kept_normalizing(*image_size, like.device, like.dtype)
    return _normalizing(*image_size, like.device, like.dtype)


def _normalizing(
    height: int, width: int, device: torch.device, dtype: torch.dtype
) -> tuple[Tensor, Tensor]:
    # Not torch.tensor, which copies numbers of the host to the device and waits for them.
    slope = torch.linspace(2 / width, 2 / height, 2, device=device, dtype=dtype)
    at_zero = torch.linspace(1 / width - 1, 1 / height - 1, 2, device=device, dtype=dtype)
    return at_zero, slope


# On the CPU, where to make four numbers takes longer than to use them; not of inference mode, whose
# tensors no later gradient could use.
_kept_normalizing = lru_cache(maxsize=64)(torch.inference_mode(False)(_normalizing))


@without_autocast
def resize_pixels(
    pixels: Tensor, *, old_size: tuple[int, int], new_size: tuple[int, int]
) -> Tensor:
    """Where pixels ``(*B, 2)`` of an image go when it is resized; what is NaN stays so.

    Raises:
        ShapeError: pixels are not ``(*B, 2)``.
        ValueError: a size is smaller than one pixel.

    Example:
        >>> resize_pixels(torch.tensor([0.0, 0.0]), old_size=(4, 4), new_size=(2, 2))
        tensor([-0.2500, -0.2500])
    """
    check_shapes(pixels=(pixels, "2"))
    check_image_size(old_size)
    check_image_size(new_size)
    along_x, along_y = new_size[1] / old_size[1], new_size[0] / old_size[0]
    # As above: numbers of the host would be waited for.
    scale = torch.linspace(along_x, along_y, 2, device=pixels.device, dtype=pixels.dtype)
    return scale * (pixels + 0.5) - 0.5


def intrinsics(fx: Tensor, fy: Tensor, cx: Tensor, cy: Tensor) -> Tensor:
    """K ``(*B, 3, 3)`` without skew, from four ``(*B)``."""
    none = torch.zeros_like(fx)
    return matrix3(fx, none, cx, none, fy, cy, none, none, torch.ones_like(fx))


@without_autocast
def resize_intrinsics(K: Tensor, *, old_size: tuple[int, int], new_size: tuple[int, int]) -> Tensor:
    """Intrinsics ``(*B, 3, 3)`` of the resized image; each axis has its own scale.

    Raises:
        ShapeError: K is not ``(*B, 3, 3)``.
        ValueError: a size is smaller than one pixel.
    """
    check_shapes(K=(K, "3 3"))
    check_image_size(old_size)
    check_image_size(new_size)
    sx, sy = new_size[1] / old_size[1], new_size[0] / old_size[0]
    # Row by row: a matrix of these numbers would be copied to the device and waited for.
    x, y, last = K.unbind(dim=-2)
    return torch.stack([sx * x + (sx - 1) / 2 * last, sy * y + (sy - 1) / 2 * last, last], dim=-2)


@without_autocast
def crop_intrinsics(K: Tensor, *, left: float, top: float) -> Tensor:
    """Intrinsics ``(*B, 3, 3)`` of the image whose pixel (0, 0) was (left, top)."""
    check_shapes(K=(K, "3 3"))
    x, y, last = K.unbind(dim=-2)
    return torch.stack([x - left * last, y - top * last, last], dim=-2)
