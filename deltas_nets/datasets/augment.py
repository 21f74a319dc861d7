"""From rooms as rendered, or frames as read, to what a training step sees."""

from collections.abc import Iterable
from typing import Any, cast

import torch
import torch.nn.functional as F
from kornia.augmentation import (
    RandomGamma,
    RandomGaussianBlur,
    RandomGaussianNoise,
    RandomJPEG,
    RandomLinearIllumination,
    RandomMotionBlur,
    RandomRGBShift,
    RandomSaturation,
)
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor, nn

from deltas_geom import PosedViews
from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.datasets.camera_effects import (
    RandomCornerBlur,
    RandomRollingExposure,
    RandomVignetting,
)


def choose_views(batch: PosedImages, order: Tensor) -> PosedImages:
    """The anchor and the sources of every room.

    Args:
        batch: ``(B, V, ...)``.
        order: ``(B, W)`` int64, which of the V views; the first becomes the anchor.
    """
    row = torch.arange(len(order), device=order.device)[:, None]
    views = PosedViews(batch.views.K[row, order], batch.views.cam_from_world[row, order])
    return PosedImages(batch.images[row, order], views, batch.depth[row, order])


def first_views(batch: PosedImages, num_views: int) -> PosedImages:
    """The anchor and the first of its sources: ``(B, num_views, ...)``."""
    views = PosedViews(*(tensor[:, :num_views] for tensor in batch.views))
    return PosedImages(batch.images[:, :num_views], views, batch.depth[:, :num_views])


def mirror(batch: PosedImages, flips: Tensor) -> PosedImages:
    """Mirror some rooms left to right, cameras and all.

    Args:
        batch: ``(B, V, ...)``.
        flips: ``(B,)`` bool.
    """
    width = batch.images.shape[-1]
    K = batch.views.K.clone()
    K[..., 0, 1] = -K[..., 0, 1]  # skew leans to the other side
    K[..., 0, 2] = width - 1 - K[..., 0, 2]
    reflect = torch.eye(4, device=K.device, dtype=K.dtype)
    reflect[0, 0] = -1
    mirrored = PosedImages(
        batch.images.flip(-1),
        PosedViews(K, reflect @ batch.views.cam_from_world @ reflect),
        batch.depth.flip(-1),
    )

    def pick(flipped: Tensor, straight: Tensor) -> Tensor:
        return torch.where(flips.view(-1, *[1] * (straight.ndim - 1)), flipped, straight)

    return PosedImages(
        pick(mirrored.images, batch.images),
        PosedViews(*(pick(*pair) for pair in zip(mirrored.views, batch.views, strict=True))),
        pick(mirrored.depth, batch.depth),
    )


def resize(batch: PosedImages, size: tuple[int, int]) -> PosedImages:
    """Shrink images by area, depth by nearest centre, and carry the intrinsics along."""
    old = (batch.images.shape[-2], batch.images.shape[-1])
    if old == size:
        return batch
    images = F.interpolate(batch.images.flatten(0, 1), size=size, mode="bilinear", antialias=True)
    images = images.reshape(*batch.images.shape[:-2], *size)
    depth = F.interpolate(batch.depth, size=size, mode="nearest-exact")
    return PosedImages(images, batch.views.resize(old_size=old, new_size=size), depth)


class Photometry(nn.Module):
    """What a camera does to light, differently in every view: kornia's augmentations and ours."""

    def __init__(self) -> None:
        super().__init__()
        self.steps = nn.Sequential(
            # Lens and shutter come before the curve: what it saturates has no darker corners.
            RandomCornerBlur(strength=(0.3, 1.0), p=0.2),
            RandomVignetting(corner=(0.55, 1.0), p=0.4),
            RandomRollingExposure(amplitude=(0.0, 0.15), periods=(0.5, 3.0), p=0.2),
            RandomGamma(gamma=(0.65, 1.5), gain=(0.65, 1.45), p=1.0),
            RandomRGBShift(0.07, 0.05, 0.07, p=0.7),
            RandomSaturation((0.3, 1.3), p=0.5),
            RandomLinearIllumination(gain=(0.01, 0.25), p=0.3),
            RandomGaussianBlur((5, 5), (0.3, 1.2), p=0.3),
            RandomMotionBlur((3, 9), angle=180.0, direction=(-0.3, 0.3), p=0.25),
            RandomGaussianNoise(0.0, 0.015, p=0.7),
            RandomJPEG(jpeg_quality=(40.0, 95.0), p=0.3),
        )

    def forward(
        self, images: Tensor, seed: int, *, first: int = 0, places: int | None = None
    ) -> Tensor:
        """Augment ``(B, V, 3, H, W)`` in [0, 1]; the same seed does the same.

        Args:
            images: of B rooms.
            seed: of the whole step.
            first: place of the first of these rooms in the step.
            places: rooms of the whole step, B if not given. What happens to a room depends on
                its place, not on which others are here.
        """
        batch, views = images.shape[:2]
        whole = ((batch if places is None else places) * views, *images.shape[2:])
        rows = slice(first * views, (first + batch) * views)
        changed = images.flatten(0, 1)
        # kornia draws from torch's global generators; they are put back afterwards.
        on_gpu = [images.device] if images.is_cuda else []
        with torch.random.fork_rng(devices=on_gpu):
            torch.manual_seed(seed)
            for step in cast(Iterable[Any], self.steps):
                step.set_rng_device_and_dtype(images.device, images.dtype)
                drawn = step.forward_parameters(whole)
                changed = step(changed, params={k: _own(k, v, rows) for k, v in drawn.items()})
        return changed.clamp(0, 1).reshape(images.shape)


def _own(name: str, drawn: Tensor, rows: slice) -> Tensor:
    """The rows of some images in what kornia drew for all."""
    if name == "forward_input_shape":
        return drawn
    if name == "idx":  # whose blur has the size that all have
        return torch.zeros_like(drawn)
    return drawn[rows]


def draw_pose_errors(
    num_views: int, noise: tuple[float, float], generator: torch.Generator
) -> Tensor:
    """Tracking errors of a room's views: motions ``(V, 4, 4)``, the first one none.

    Args:
        num_views: V.
        noise: standard deviations of translation (metres) and rotation (radians), per axis.
        generator: source of randomness.
    """
    shift = noise[0] * torch.randn(num_views, 3, generator=generator)
    turn = noise[1] * torch.randn(num_views, 3, generator=generator)
    error = torch.eye(4).repeat(num_views, 1, 1)
    error[:, :3, :3] = axis_angle_to_rotation_matrix(turn)
    error[:, :3, 3] = shift
    error[0] = torch.eye(4)  # the anchor defines the frame
    return error


def disturb_poses(views: PosedViews, errors: Tensor) -> PosedViews:
    """Views ``(B, V)`` whose poses are off by ``errors``, ``(B, V, 4, 4)`` motions."""
    return views._replace(cam_from_world=errors.to(views.K) @ views.cam_from_world)
