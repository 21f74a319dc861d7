"""What is wrong with frames: poses, cameras and images, each by a known amount and always the same.

Every frame errs in a direction of its own, drawn from a seed and its id; the amount is the same for
all, so that a curve is smooth and its steps can be compared.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace

import numpy as np
import torch
from kornia.filters import gaussian_blur2d
from numpy.typing import NDArray

from deltas_nets.captures.frame import Frame

__all__ = [
    "ChangedImage",
    "FrameChange",
    "blurred",
    "calibrated_wrong",
    "exposed",
    "moved",
    "turned",
]

FrameChange = Callable[[Frame], Frame]
Image = NDArray[np.uint8]


def moved(metres: float, seed: int) -> FrameChange:
    """Cameras so far from where they stood, each in a direction of its own."""

    def change(frame: Frame) -> Frame:
        pose = frame.cam_from_world.copy()
        pose[:3, 3] += metres * _direction(frame, seed)
        return replace(frame, cam_from_world=pose)

    return change


def turned(degrees: float, seed: int) -> FrameChange:
    """Cameras turned so far about themselves, each about an axis of its own."""

    def change(frame: Frame) -> Frame:
        pose = frame.cam_from_world.copy()
        pose[:3] = _rotation(np.radians(degrees) * _direction(frame, seed)) @ pose[:3]
        return replace(frame, cam_from_world=pose)

    return change


def calibrated_wrong(share: float) -> FrameChange:
    """Focal lengths too long by a share, of all frames: a calibration is shared."""

    def change(frame: Frame) -> Frame:
        K = frame.K.copy()
        K[[0, 1], [0, 1]] *= 1 + share
        return replace(frame, K=K)

    return change


def blurred(sigma: float) -> FrameChange:
    """Images blurred by a Gaussian, its deviation a share of the image's width."""

    def blur(image: Image, _: Frame) -> Image:
        deviation = sigma * image.shape[1]
        if deviation <= 0:
            return image
        size = 2 * int(np.ceil(3 * deviation)) + 1
        pixels = torch.from_numpy(image.copy()).permute(2, 0, 1)[None].float()
        soft = gaussian_blur2d(pixels, (size, size), (deviation, deviation))
        result: Image = soft[0].round().clamp(0, 255).byte().permute(1, 2, 0).numpy()
        return result

    return lambda frame: ChangedImage.of(frame, blur)


def exposed(stops: float, seed: int) -> FrameChange:
    """Light of each image times a factor between 2^-stops and 2^stops, clipped as sensors do.

    Values are linear in light for a gamma of 2.2.
    """

    def expose(image: Image, frame: Frame) -> Image:
        share = _generator(frame, seed).uniform(-1, 1)
        factor = 2.0 ** (stops * share / 2.2)
        result: Image = (image * factor).round().clip(0, 255).astype(np.uint8)
        return result

    return lambda frame: ChangedImage.of(frame, expose)


@dataclass(frozen=True, eq=False)
class ChangedImage(Frame):
    """A frame whose image is changed after it is read."""

    before: Frame = field(kw_only=True)
    by: Callable[[Image, Frame], Image] = field(kw_only=True)

    @classmethod
    def of(cls, frame: Frame, by: Callable[[Image, Frame], Image]) -> "ChangedImage":
        """The same frame but for its image."""
        same = {part.name: getattr(frame, part.name) for part in fields(Frame)}
        return cls(**same, before=frame, by=by)

    @property
    def extent(self) -> float:
        """As before."""
        return self.before.extent

    def read_image(self) -> Image:
        """The changed image."""
        return self.by(self.before.read_image(), self)

    def read_resized(self, size: tuple[int, int]) -> Image:
        """The image at another size, changed there."""
        return self.by(self.before.read_resized(size), self)


def _generator(frame: Frame, seed: int) -> np.random.Generator:
    """The frame's own, whatever was drawn before."""
    digest = hashlib.sha256(f"{seed} {frame.id}".encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:8], "little"))


def _direction(frame: Frame, seed: int) -> NDArray[np.float64]:
    drawn = _generator(frame, seed).standard_normal(3)
    unit: NDArray[np.float64] = drawn / np.linalg.norm(drawn)
    return unit


def _rotation(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of an axis times an angle (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle == 0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rest: NDArray[np.float64] = np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return np.eye(3) + rest
