"""How alike anchor and sources look around every pixel, at every inverse depth."""

import torch
import torch.nn.functional as F
from torch import Tensor

from deltas_geom import PosedViews, normalize_pixels, pixel_grid, sample_inv_depths

CHUNK = 16
"""Planes that are warped together: more of them fit no processor's cache."""


def similarity_volume(
    images: Tensor, views: PosedViews, inv_depths: Tensor, *, window: int, noise: float
) -> Tensor:
    """Normalised cross-correlation of windows, fused over the sources.

    It is the mean over the sources that see a place. The mean of the better half of them, which
    forgives a source in which the place is hidden, was worse on rooms with two sources and with
    six: of as many planes the best by chance is better then.

    Args:
        images: ``(V, 1, H, W)`` grey, in [0, 1]; view 0 is the anchor.
        views: ``(V,)`` their cameras.
        inv_depths: ``(S,)`` 1/m.
        window: its side, pixels, odd.
        noise: standard deviation of grey values; windows that vary less than that are like none.

    Returns:
        ``(S, H, W)`` within [-1, 1]; 0 where no source sees the place.
    """
    size = (images.shape[-2], images.shape[-1])
    anchor = _Windows(images[:1], window, noise)
    pixels = pixel_grid(size, device=images.device, dtype=views.K.dtype)
    parts = []
    for planes in torch.split(inv_depths, CHUNK):
        total = images.new_zeros(len(planes), *size)
        seen = torch.zeros_like(total)
        for source in range(1, len(images)):
            pair = views.select([0, source])
            places = sample_inv_depths(pair, pixels, planes, image_size=size)
            grid = normalize_pixels(places.pixels[0, :, 0].transpose(0, 1), image_size=size)
            grid = grid.reshape(1, len(planes) * size[0], size[1], 2)
            warped = F.grid_sample(
                images[source : source + 1], grid, padding_mode="border", align_corners=False
            ).reshape(len(planes), 1, *size)
            mask = places.mask[0, :, 0].mT.reshape(len(planes), *size)
            total += torch.where(mask, anchor.correlation(warped), 0.0)
            seen += mask
        parts.append(total / seen.clamp_min(1))
    return torch.cat(parts)


class _Windows:
    """The anchor's windows, to which many warped images are compared."""

    def __init__(self, image: Tensor, window: int, noise: float) -> None:
        self.window = window
        self.noise = noise
        self.mean = self._mean(image)
        # Grey values around their local mean: variances are not lost to rounding.
        self.image = image
        self.variance = (self._mean(image.square()) - self.mean.square()).clamp_min(0)

    def correlation(self, warped: Tensor) -> Tensor:
        """``(S, H, W)`` of images ``(S, 1, H, W)``."""
        mean = self._mean(warped)
        variance = (self._mean(warped.square()) - mean.square()).clamp_min(0)
        covariance = self._mean(warped * self.image) - mean * self.mean
        floor = self.noise**2
        scale = ((variance + floor) * (self.variance + floor)).rsqrt()
        return (covariance * scale).clamp(-1, 1)[:, 0]

    def _mean(self, image: Tensor) -> Tensor:
        """Over windows cut off at the border; first along rows, then along columns."""
        reach = self.window // 2
        rows = F.avg_pool2d(
            image, (1, self.window), stride=1, padding=(0, reach), count_include_pad=False
        )
        return F.avg_pool2d(
            rows, (self.window, 1), stride=1, padding=(reach, 0), count_include_pad=False
        )
