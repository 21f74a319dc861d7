"""What lens and shutter do to light, as kornia augmentations: kornia's own illuminations add light.

Each image of a batch gets strengths of its own. Depth and cameras stay as they are.
"""

import math
from abc import abstractmethod
from typing import Any

import torch
from kornia.augmentation import IntensityAugmentationBase2D
from kornia.filters import gaussian_blur2d
from torch import Tensor

Range = tuple[float, float]

CORNER_SIGMA, CORNER_KERNEL = 1.5, 7  # px


def vignetting_gain(corner: Tensor, *, image_size: tuple[int, int]) -> Tensor:
    r"""How much of the centre's light each pixel gets: the cosine-fourth law.

    At an angle :math:`\theta` from the axis, which is taken to meet the image's centre, that is
    :math:`\cos^4 \theta = (1 + \tan^2 \theta)^{-2}`; the tangent grows with the distance in pixels.

    Args:
        corner: ``(B,)``, the gain at the outer corners of the corner pixels, above 0 and at most 1.
        image_size: ``(height, width)``.

    Returns:
        ``(B, 1, H, W)``, 1 at the image's centre.
    """
    steepest = corner.rsqrt().sub(1).view(-1, 1, 1, 1)  # tan^2 at the corners
    return (1 + steepest * _squared_radius(image_size, corner)).square().reciprocal()


def exposure_wave(amplitude: Tensor, periods: Tensor, phase: Tensor, *, length: int) -> Tensor:
    """The gain of each row of an image whose exposure changes while the rows are read.

    Args:
        amplitude: ``(B,)``, the largest deviation from 1.
        periods: ``(B,)``, waves in the image.
        phase: ``(B,)``, of the wave at the image's border, in turns.
        length: number of rows.

    Returns:
        ``(B, length)``.
    """
    rows = torch.arange(length, device=phase.device, dtype=phase.dtype)
    turns = periods[:, None] * ((rows + 0.5) / length) + phase[:, None]
    return 1 + amplitude[:, None] * torch.sin(2 * math.pi * turns)


def blur_corners(images: Tensor, strength: Tensor) -> Tensor:
    """Images whose sharpness falls off from the centre with the square of the distance.

    Args:
        images: ``(B, C, H, W)``.
        strength: ``(B,)``, 0 to 1: the share of the blurred image at the corners.

    Returns:
        ``(B, C, H, W)``, the image itself at the centre.
    """
    # One width for all, as kornia reads drawn widths back from the device to check them. Images as
    # channels of a single one: five times as fast on a CPU.
    blurred = gaussian_blur2d(
        images.flatten(0, 1)[None],
        CORNER_KERNEL,
        (CORNER_SIGMA, CORNER_SIGMA),
        border_type="replicate",
    )
    size = (images.shape[-2], images.shape[-1])
    share = strength.view(-1, 1, 1, 1) * _squared_radius(size, images)
    return torch.lerp(images, blurred.reshape(images.shape), share)


class _CameraEffect(IntensityAugmentationBase2D):  # type: ignore[misc]
    """An effect whose strengths are drawn evenly from ranges, by name."""

    def __init__(self, p: float, **ranges: Range) -> None:
        super().__init__(p=p)
        self.flags = ranges

    def generate_parameters(self, batch_shape: tuple[int, ...]) -> dict[str, Tensor]:
        # kornia's PlainUniformGenerator would fetch what a GPU has drawn, and so wait for it.
        undrawn = torch.empty(batch_shape[0], device=self.device, dtype=self.dtype)
        return {
            name: undrawn.clone().uniform_(low, high) for name, (low, high) in self.flags.items()
        }

    def apply_transform(
        self,
        images: Tensor,
        params: dict[str, Tensor],
        flags: dict[str, Any],
        transform: Tensor | None = None,
    ) -> Tensor:
        """Images ``(B, C, H, W)`` in [0, 1]."""
        drawn = {name: params[name].to(images) for name in self.flags}
        return self._changed(images, drawn).clamp(0, 1)

    @abstractmethod
    def _changed(self, images: Tensor, drawn: dict[str, Tensor]) -> Tensor:
        """The images by strengths ``(B,)``, by name; what leaves [0, 1] is cut off."""


class RandomVignetting(_CameraEffect):
    """Darken images towards their corners: see :func:`vignetting_gain`.

    Args:
        corner: range of the corners' light, as a share of the centre's.
        p: probability that an image is changed.
    """

    def __init__(self, corner: Range = (0.55, 1.0), p: float = 0.5) -> None:
        super().__init__(p, corner=corner)

    def _changed(self, images: Tensor, drawn: dict[str, Tensor]) -> Tensor:
        size = (images.shape[-2], images.shape[-1])
        return images * vignetting_gain(drawn["corner"], image_size=size)


class RandomRollingExposure(_CameraEffect):
    """Light that changes while a shutter rolls: bands of lamps, exposure that adapts.

    The bands lie along rows or columns, as phones are held either way: see :func:`exposure_wave`.

    Args:
        amplitude: range of the gain's largest deviation from 1.
        periods: range of the number of waves in the image.
        p: probability that an image is changed.
    """

    def __init__(
        self, amplitude: Range = (0.0, 0.15), periods: Range = (0.5, 3.0), p: float = 0.5
    ) -> None:
        super().__init__(p, amplitude=amplitude, periods=periods, phase=(0, 1), axis=(0, 1))

    def _changed(self, images: Tensor, drawn: dict[str, Tensor]) -> Tensor:
        wave = drawn["amplitude"], drawn["periods"], drawn["phase"]
        rows = exposure_wave(*wave, length=images.shape[-2])[:, None, :, None]
        columns = exposure_wave(*wave, length=images.shape[-1])[:, None, None, :]
        by_row = drawn["axis"].view(-1, 1, 1, 1) < 0.5
        return images * torch.where(by_row, rows, columns)


class RandomCornerBlur(_CameraEffect):
    """Blur images towards their corners: see :func:`blur_corners`.

    Args:
        strength: range of the blurred image's share at the corners.
        p: probability that an image is changed.
    """

    def __init__(self, strength: Range = (0.3, 1.0), p: float = 0.5) -> None:
        super().__init__(p, strength=strength)

    def _changed(self, images: Tensor, drawn: dict[str, Tensor]) -> Tensor:
        return blur_corners(images, drawn["strength"])


def _squared_radius(image_size: tuple[int, int], like: Tensor) -> Tensor:
    """``(H, W)``: 0 at the image's centre, 1 at the outer corners of its corner pixels."""
    y, x = (
        torch.arange(length, device=like.device, dtype=like.dtype) - (length - 1) / 2
        for length in image_size
    )
    height, width = image_size
    return (y.square()[:, None] + x.square()) / ((height / 2) ** 2 + (width / 2) ** 2)
