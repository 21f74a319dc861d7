"""A lens that bends lines, straightened for the network, and maps bent back onto the photo."""

from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from functools import lru_cache
from threading import Lock
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from deltas_geom import Lens
from deltas_geom.cameras.pixels import normalize_pixels, pixel_grid, resize_intrinsics
from deltas_geom.cameras.projection import pixel_rays
from deltas_nets.captures.frame import FloatArray, Frame
from deltas_nets.captures.frame import Lens as FrameLens
from deltas_nets.captures.images import resize_image

__all__ = [
    "StraightFrame",
    "in_photo",
    "lens_of",
    "photo_pixels",
    "pixels_of_photo",
    "straight",
    "straight_pixels",
]

WIDEST = np.cos(np.radians(60))
"""What a lens sees farther off its axis is left out: a straight image of it would be all border."""
MOST = 1.5
"""Times the usual pixels that the network sees of a wide straight image, so that it is as fine."""
_ACROSS = 33  # pixels of the photo, along each side, that the straight image is made to hold
_FINER = 2  # times the wanted size, at which an image is straightened before it is made smaller
_ENOUGH = 1 << 21  # pixels: of more an image need not be finer than the photo, and takes memory
_AT_ONCE = 1 << 18  # pixels: what a lens computes of each takes 200 bytes
_ALONE = Lock()  # threads want the same grid at the same time, of which one is enough


@dataclass(frozen=True, eq=False)
class StraightFrame(Frame):
    """A frame as a pinhole camera in the lens's place would have taken it: K and size are its."""

    photo: Frame = field(kw_only=True)
    """As it was taken."""

    def read_image(self) -> NDArray[np.uint8]:
        """Decode the photo and straighten it; what the lens did not see repeats the border."""
        return self._straightened(self.photo.read_image(), self.image_size)

    def read_resized(self, size: tuple[int, int]) -> NDArray[np.uint8]:
        """Straighten the photo at about the size that is wanted."""
        pixels = self.photo.read_image()
        finer = (_FINER * size[0], _FINER * size[1])
        if finer[0] * finer[1] > _ENOUGH:
            at_most = (min(wanted, own) for wanted, own in zip(finer, self.image_size, strict=True))
            finer = (max(size[0], next(at_most)), max(size[1], next(at_most)))
        share = max(finer[0] / self.image_size[0], finer[1] / self.image_size[1])
        if share < 1:
            height, width = self.photo.image_size
            pixels = resize_image(pixels, (round(share * height), round(share * width)))
        return resize_image(self._straightened(pixels, finer), size)

    @property
    def extent(self) -> float:
        """How much more it shows than an image of its size with the photo's focal length."""
        wider: float = self.photo.K[0, 0] / self.K[0, 0]
        return min(max(wider**2, 1.0), MOST)

    def _straightened(self, pixels: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
        """A photo of any size, as a straight image of any size."""
        given = (pixels.shape[0], pixels.shape[1])
        image = torch.from_numpy(pixels.copy()).permute(2, 0, 1)[None].float()
        camera = _Straight(self.K.tobytes(), self.image_size)
        with _ALONE:
            grid = _grid(_Seen.of(self.photo), given, camera, size)
        straightened = np.empty((*size, image.shape[1]), dtype=np.uint8)
        for rows in _strips(size):
            # Cubic: linear between pixels is a blur, which costs matches.
            seen = F.grid_sample(
                image, grid[:, rows], mode="bicubic", padding_mode="border", align_corners=False
            )
            straightened[rows] = seen[0].round_().clamp_(0, 255).byte().permute(1, 2, 0).numpy()
        return straightened


class _Seen(NamedTuple):
    """What tells a photo's camera from others: a capture has few."""

    K: bytes
    lens: FrameLens
    image_size: tuple[int, int]

    @classmethod
    def of(cls, photo: Frame) -> "_Seen":
        """The camera of a photo."""
        lens = photo.lens or FrameLens("PINHOLE", ())
        return cls(photo.K.tobytes(), lens, photo.image_size)

    def resized(self, size: tuple[int, int]) -> Lens:
        """The lens for photos of a size."""
        K = torch.tensor(np.frombuffer(self.K).reshape(3, 3))
        coefficients = torch.tensor(self.lens.coefficients, dtype=torch.float64)
        at_size = resize_intrinsics(K, old_size=self.image_size, new_size=size)
        return Lens(at_size, coefficients, self.lens.model)


class _Straight(NamedTuple):
    """A pinhole camera."""

    K: bytes
    image_size: tuple[int, int]

    def resized(self, size: tuple[int, int]) -> torch.Tensor:
        """``(3, 3)`` for images of a size."""
        K = torch.tensor(np.frombuffer(self.K).reshape(3, 3))
        return resize_intrinsics(K, old_size=self.image_size, new_size=size)


@lru_cache(maxsize=4)
def _grid(
    seen: _Seen, photo_size: tuple[int, int], camera: _Straight, size: tuple[int, int]
) -> torch.Tensor:
    """``(1, H, W, 2)`` where a straight image of a size reads a photo of another."""
    lens, K = seen.resized(photo_size), camera.resized(size)
    grid = torch.empty(1, *size, 2)
    for rows in _strips(size):
        pixels = lens.project(pixel_rays(K, _pixels_of(rows, size[1]))).pixels
        normal = normalize_pixels(pixels, image_size=photo_size)
        grid[0, rows] = normal.float().view(-1, size[1], 2)
    return grid


@lru_cache(maxsize=2)
def _places(seen: _Seen, camera: _Straight, size: tuple[int, int]) -> NDArray[np.int64]:
    lens, K = seen.resized(size), camera.resized(camera.image_size)
    height, width = camera.image_size
    places = np.empty(size, dtype=np.int64)
    for rows in _strips(size):
        rays, valid = lens.unproject(_pixels_of(rows, size[1]))
        ahead = valid & (rays[:, 2] > 0)
        x, y, w = (torch.where(ahead[:, None], rays, 0.0) @ K.mT).T
        depth = torch.where(ahead, w, 1.0)
        column, row = (x / depth).round().long(), (y / depth).round().long()
        inside = ahead & (row >= 0) & (row < height) & (column >= 0) & (column < width)
        found = torch.where(inside, row * width + column, -1)
        places[rows] = found.view(-1, size[1]).numpy()
    return places


def _strips(size: tuple[int, int]) -> Iterator[slice]:
    """The rows of an image, some at a time."""
    few = max(1, _AT_ONCE // size[1])
    for start in range(0, size[0], few):
        yield slice(start, min(start + few, size[0]))


def _pixels_of(rows: slice, width: int) -> torch.Tensor:
    """The pixels ``(N, 2)`` of some rows."""
    pixels = pixel_grid((rows.stop - rows.start, width), dtype=torch.float64)
    pixels[:, 1] += rows.start
    return pixels


def lens_of(photo: Frame) -> Lens:
    """The lens of a photo at its own size; a pinhole where straight lines are straight in it."""
    return _Seen.of(photo).resized(photo.image_size)


def straight(frame: Frame) -> Frame:
    """The frame itself where straight lines are straight in it, else a `StraightFrame`."""
    if frame.lens is None:
        return frame
    K, size = _straight_camera(frame)
    same = {part.name: getattr(frame, part.name) for part in fields(Frame)}
    return StraightFrame(**same | {"K": K, "image_size": size, "lens": None}, photo=frame)


def _straight_camera(photo: Frame) -> tuple[FloatArray, tuple[int, int]]:
    """A pinhole camera that sees what the lens does, as finely as at its middle or less."""
    height, width = photo.image_size
    rows, columns = np.mgrid[0 : 1 : _ACROSS * 1j, 0 : 1 : _ACROSS * 1j].reshape(2, -1)
    pixels = np.stack([columns * width - 0.5, rows * height - 0.5], axis=-1)
    seen = lens_of(photo).unproject(torch.from_numpy(pixels))
    rays = seen.rays[seen.valid & (seen.rays[:, 2] > WIDEST)].numpy()
    slopes = rays[:, :2] / rays[:, 2:]
    low, high = slopes.min(axis=0), slopes.max(axis=0)
    # Pixels keep their shape, and the image is as wide as the photo.
    focal = np.diag(photo.K)[:2] * (width / (high - low)[0] / photo.K[0, 0])
    size = (max(1, round(focal[1] * (high - low)[1])), width)
    centre = (np.array(size[::-1]) - 1) / 2 - focal * (low + high) / 2
    K = np.array([[focal[0], 0, centre[0]], [0, focal[1], centre[1]], [0, 0, 1]])
    return K, size


def pixels_of_photo(frame: StraightFrame, size: tuple[int, int]) -> NDArray[np.int64]:
    """For each pixel of the photo, resized to ``size``, the straight image's pixel.

    Returns:
        ``(H, W)`` places in the flattened straight image; -1 where that does not show it.
    """
    camera = _Straight(frame.K.tobytes(), frame.image_size)
    with _ALONE:
        return _places(_Seen.of(frame.photo), camera, size)


def photo_pixels(
    frame: StraightFrame, pixels: torch.Tensor, size: tuple[int, int], photo_size: tuple[int, int]
) -> torch.Tensor:
    """Where pixels ``(N, 2)`` of the straight image, at a size, are in the photo at another."""
    camera = _Straight(frame.K.tobytes(), frame.image_size)
    rays = pixel_rays(camera.resized(size), pixels.double().cpu())
    seen = _Seen.of(frame.photo).resized(photo_size).project(rays).pixels
    return seen.to(pixels)


def in_photo(frame: StraightFrame, points: FloatArray) -> NDArray[np.bool_]:
    """Which points ``(N, 3)`` of the world, in front of the camera, are in the photo's frame."""
    pose, (height, width) = frame.cam_from_world, frame.photo.image_size
    local = torch.from_numpy(points @ pose[:3, :3].T + pose[:3, 3])
    pixels, valid = lens_of(frame.photo).project(local)
    x, y = pixels.unbind(dim=-1)
    inside = (x >= -0.5) & (x < width - 0.5) & (y >= -0.5) & (y < height - 0.5)
    shown: NDArray[np.bool_] = (valid & inside).numpy()
    return shown


def straight_pixels(
    frame: StraightFrame, pixels: torch.Tensor
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Where pixels ``(N, 2)`` of the photo are in the straight image, and which it shows."""
    rays, valid = lens_of(frame.photo).unproject(pixels.double())
    ahead = valid & (rays[:, 2] > 0)
    x, y, w = (torch.where(ahead[:, None], rays, 1.0) @ torch.from_numpy(frame.K).mT).T
    found = torch.stack([x / w, y / w], dim=-1)
    width_height = torch.tensor(frame.image_size[::-1])
    inside = ((found >= -0.5) & (found < width_height - 0.5)).all(dim=-1)
    return found.numpy(), (ahead & inside).numpy()
