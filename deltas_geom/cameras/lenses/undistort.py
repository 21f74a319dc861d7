"""What a pinhole camera in the lens's place would see: its K, its pixels, its image."""

import math
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import safe_divide
from deltas_geom.cameras.lenses.lens import Lens, LensPixels
from deltas_geom.cameras.pixels import in_image, intrinsics, pixel_grid, read_map
from deltas_geom.cameras.projection import pixel_rays
from deltas_geom.checks import ShapeError, batch_shape, check_image_size, check_kind, check_shapes
from deltas_geom.numerics.arithmetic import (
    finite_or_zero,
    only,
    surely_all,
    unless_all,
    without_autocast,
    without_gradients,
)
from deltas_geom.records import Record

_WIDEST = math.cos(math.radians(80))
"""Rays further from the axis stretch an image too far to be worth a pinhole camera's pixels."""
_ALONG = 129  # pixels of a side of the border
_HALVINGS = 16  # between the principal point and the border


class UndistortedImage(Record):
    """What a pinhole camera sees.

    Attributes:
        image: ``(*B, C, H, W)``; 0 where the mask is False.
        K: ``(*B, 3, 3)`` of that camera.
        mask: ``(*B, 1, H, W)`` bool: the lens saw it.
    """

    image: Tensor
    K: Tensor
    mask: Tensor


def undistort_pixels(lens: Lens, pixels: Tensor, new_K: Tensor | None = None) -> LensPixels:
    """Where a pinhole camera in the lens's place has the pixels of a lens, differentiably.

    Args:
        lens: which saw the pixels.
        pixels: ``(*B, N, 2)``.
        new_K: ``(*B, 3, 3)`` of the pinhole camera; that of the lens without it (for
            EQUIRECTANGULAR, too, though its focal lengths are px/rad).

    Returns:
        Not valid are pixels of no ray (:meth:`Lens.unproject`), or of one that a pinhole camera
        cannot see, 90 degrees or more off its axis; they are (0, 0), but NaN where a pixel or lens
        is not finite.

    Raises:
        ShapeError: a trailing shape differs, or batch dims do not broadcast.

    Example:
        >>> K = torch.tensor([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
        >>> lens = Lens(K, torch.tensor([-0.1]), "SIMPLE_RADIAL")
        >>> undistort_pixels(lens, torch.tensor([[306.25, 120.0]])).pixels
        tensor([[310., 120.]])
    """
    check_kind("lens", lens, Lens, "Lens(K, coefficients, model)")
    new_K = lens.K if new_K is None else new_K
    check_shapes(new_K=(new_K, "3 3"))
    return LensPixels(*_straightened(lens.K, lens.coefficients, lens.model, pixels, new_K))


@without_autocast
def _straightened(
    K: Tensor, coefficients: Tensor, model: str, pixels: Tensor, new_K: Tensor
) -> tuple[Tensor, Tensor]:
    rays, valid = Lens(K, coefficients, model).unproject(pixels)
    straight, ahead = Lens(new_K, new_K.new_zeros(0), "PINHOLE").project(rays)
    straight = only(straight, valid.unsqueeze(-1))
    # For a triangulation without the mask: a wrong pixel would be believed.
    cameras = (x.unsqueeze(-2) for x in (K.flatten(-2), coefficients, new_K.flatten(-2)))
    # Where all are valid no pixel is NaN, which to ask costs a tenth.
    for part in (*cameras, *(() if surely_all(valid) else (pixels,))):
        finite = part.isfinite().all(dim=-1, keepdim=True)
        straight = only(straight, unless_all(finite), other=torch.nan)
    return straight, ahead & valid


def undistort_image(
    lens: Lens,
    image: Tensor,
    *,
    new_K: Tensor | None = None,
    new_size: tuple[int, int] | None = None,
    alpha: float = 0.0,
    mode: str = "bilinear",
) -> UndistortedImage:
    """The image that a pinhole camera in the lens's place would see.

    Args:
        lens: which saw the image, one or ``*B``.
        image: ``(*B, C, H, W)``; a number that is NaN or infinite counts as 0.
        new_K: ``(*B, 3, 3)`` of the pinhole camera. Without it it looks through the same centre at
            a rectangle that ``alpha`` tells, and which is chosen without gradient: that of the
            image by the lens is for this K held.
        new_size: (height, width) of the result; as the image without it.
        alpha: 0: every pixel of the result was seen; 1: every pixel of the image is in the
            result, with black around it; between, a mixture, as in OpenCV's
            ``getOptimalNewCameraMatrix``. What is more than 80 degrees off the axis, or that the
            lens does not see, is not asked for.
        mode: "bilinear", or "nearest" for depth and labels.

    Returns:
        The image, K and where the lens saw something. Depth along z stays what it is.

    Raises:
        ShapeError: a trailing shape differs, or batch dims do not broadcast.
        ValueError: ``alpha`` is not in [0, 1], a size is smaller than one pixel, or ``mode`` is
            neither.

    Example:
        >>> K = torch.tensor([[300.0, 0, 159.5], [0, 300, 119.5], [0, 0, 1]])
        >>> lens = Lens(K, torch.tensor([-0.2, 0.0, 0.0, 0.0]), "OPENCV")
        >>> undistorted = undistort_image(lens, torch.rand(3, 240, 320))
        >>> bool(undistorted.mask.all())
        True
    """
    check_kind("lens", lens, Lens, "Lens(K, coefficients, model)")
    check_shapes(image=(image, "C H W"))
    if image.shape[-1] <= 4 < image.shape[-3]:
        raise ShapeError(f"image ends in channels, {tuple(image.shape)}: use image.movedim(-1, -3)")
    if not 0 <= alpha <= 1:
        raise ValueError(f"alpha must be from 0 (all seen) to 1 (all kept), got {alpha}")
    if mode not in ("bilinear", "nearest"):
        raise ValueError(f"mode must be 'bilinear' or 'nearest', got {mode!r}")
    # In a trace sizes are tensors, which would divide in float32.
    old_size = (int(image.shape[-2]), int(image.shape[-1]))
    new_size = old_size if new_size is None else new_size
    check_image_size(old_size)
    check_image_size(new_size)
    view = partial(pinhole_K, old_size=old_size, new_size=new_size, alpha=alpha)
    parts = (lens.K, lens.coefficients, lens.model, image, new_K)
    return UndistortedImage(*_remapped(*parts, view, new_size, mode))


@without_autocast
def _remapped(
    K: Tensor,
    coefficients: Tensor,
    model: str,
    image: Tensor,
    new_K: Tensor | None,
    view: Callable[[Lens], Tensor],
    new_size: tuple[int, int],
    mode: str,
) -> tuple[Tensor, Tensor, Tensor]:
    lens = Lens(K, coefficients, model)
    new_K = view(lens) if new_K is None else new_K
    check_shapes(new_K=(new_K, "3 3"))
    batch = batch_shape(image.shape[:-3], K.shape[:-2], coefficients.shape[:-1], new_K.shape[:-2])
    old_size = (int(image.shape[-2]), int(image.shape[-1]))
    grid = pixel_grid(
        new_size, device=new_K.device, dtype=torch.promote_types(new_K.dtype, K.dtype)
    )
    pixels, valid = lens.project(pixel_rays(new_K, grid))
    valid = valid & in_image(pixels.detach(), image_size=old_size)
    read = read_map(image, pixels, image_size=old_size, mode=mode)
    mask = valid.expand(*batch, valid.shape[-1]).reshape(*batch, 1, *new_size)
    image = read.reshape(*batch, image.shape[-3], *new_size)
    new_K, _ = finite_or_zero(new_K, dims=2)
    return only(image, mask), new_K.expand(*batch, 3, 3), mask


@without_gradients
def pinhole_K(
    lens: Lens, *, old_size: tuple[int, int], new_size: tuple[int, int], alpha: float
) -> Tensor:
    """K ``(*B, 3, 3)`` of the pinhole camera of :func:`undistort_image`.

    Source: OpenCV's ``getOptimalNewCameraMatrix``, with more of the border looked at.
    """
    # A trace knows nothing of no_grad.
    x, y = _border_slopes(lens.detach(), old_size).unbind(dim=-1)
    # Sides in order: left, right, top, bottom.
    inner = [
        x[..., 0, :].amax(-1),
        x[..., 1, :].amin(-1),
        y[..., 2, :].amax(-1),
        y[..., 3, :].amin(-1),
    ]
    outer = [x.amin((-2, -1)), x.amax((-2, -1)), y.amin((-2, -1)), y.amax((-2, -1))]
    height, width = new_size
    fx, cx = _mixed(inner[:2], outer[:2], width, alpha)
    fy, cy = _mixed(inner[2:], outer[2:], height, alpha)
    dtype = torch.promote_types(lens.dtype, lens.coefficients.dtype)
    return intrinsics(fx, fy, cx, cy).to(dtype)


def _mixed(
    inner: list[Tensor], outer: list[Tensor], size: int, alpha: float
) -> tuple[Tensor, Tensor]:
    """The focal length and centre with which slopes from low to high fill an image."""
    focal, center = [], []
    for low, high in (inner, outer):
        focal.append(max(size - 1, 1) / (high - low).clamp(min=1e-6))
        center.append((size - 1) / 2 - focal[-1] * (low + high) / 2)
    return torch.lerp(focal[0], focal[1], alpha), torch.lerp(center[0], center[1], alpha)


def _border_slopes(lens: Lens, image_size: tuple[int, int]) -> Tensor:
    """Slopes ``(*B, 4, 129, 2)`` of the border, or of the last pixels before it that have one."""
    height, width = image_size
    solved = lens.to(torch.float64) if lens.device.type != "mps" else lens
    x, y = (
        torch.linspace(0, last, _ALONG, device=lens.device, dtype=solved.dtype)
        for last in (width - 1, height - 1)
    )
    left, top = torch.zeros_like(x), torch.zeros_like(y)
    sides = [(left, y), (left + (width - 1), y), (x, top), (x, top + (height - 1))]
    border = torch.stack([torch.stack(side, dim=-1) for side in sides]).flatten(0, 1)
    center = solved.K[..., None, :2, 2]
    high = torch.ones_like(border[:, :1])
    rays, seen = _straight(solved, border)
    if not surely_all(seen):
        low = torch.zeros_like(high)
        for _ in range(_HALVINGS):
            middle = torch.where(seen, high, (low + high) / 2)
            _, ok = _straight(solved, center + middle * (border - center))
            low, high = torch.where(ok, middle, low), torch.where(ok, high, middle)
        share = torch.where(seen, 1.0, low)
        rays, _ = _straight(solved, center + share * (border - center))
    ahead = rays[..., 2:] > 0
    slopes = safe_divide(rays[..., :2], rays[..., 2:], ahead)
    return slopes.reshape(*slopes.shape[:-2], 4, _ALONG, 2)


def _straight(lens: Lens, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Rays, and which ``(*B, N, 1)`` are near enough to the axis."""
    rays, valid = lens.unproject(pixels)
    return rays, (valid & (rays[..., 2] > _WIDEST)).unsqueeze(-1)
