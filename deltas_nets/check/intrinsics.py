"""Camera matrices that no camera has, or that are of other images."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import FloatArray
from deltas_nets.check.finding import Fault, Finding
from deltas_nets.check.mending import changing_frames
from deltas_nets.check.rewrite import of_size, swapped, with_K
from deltas_nets.check.trying import common

__all__ = ["Suspicion", "in_a_line", "suspicion_of", "wrong_intrinsics"]

FOCAL = (0.15, 20.0)
"""Of the longer side: an angle of view of 147 degrees, and one of 3."""
USUAL_FOCAL = 0.85
SHAPES = (0.6, 1.7)  # fy / fx
CENTRAL = 0.08  # parts of the image that a principal point is off the middle, if nobody cropped
AGREEING = 0.04  # parts within which both axes tell of the same size


class Suspicion(NamedTuple):
    """What is wrong with one K.

    Attributes:
        cause: what.
        evidence: the figures.
        cure: in words.
        right: ``(3, 3)`` what K should be, if that follows.
    """

    cause: Fault
    evidence: str
    cure: str
    right: FloatArray | None


def wrong_intrinsics(capture: Capture) -> list[Finding]:
    """A finding for each kind of nonsense, with the frames of all cameras that have it."""
    arrays = capture.frames.arrays
    suspicions = [suspicion_of(camera.K, camera.image_size) for camera in arrays.cameras]
    return list(_by_cause(capture, suspicions))


def _by_cause(capture: Capture, suspicions: list[Suspicion | None]) -> Iterator[Finding]:
    camera_of = capture.frames.arrays.camera_of
    for cause in dict.fromkeys(one.cause for one in suspicions if one is not None):
        known = [(i, one) for i, one in enumerate(suspicions) if one and one.cause is cause]
        mask = np.isin(camera_of, [camera for camera, _ in known])
        if not mask.any():
            continue
        ids = () if mask.all() else tuple(capture.frames.kept(mask))
        first = known[0][1]
        right = {camera: one.right for camera, one in known if one.right is not None}
        mend = (
            changing_frames(with_K(dict(enumerate(_rights(camera_of, right))))) if right else None
        )
        yield Finding(cause, first.evidence, ids, first.cure, "error", mend)


def _rights(camera_of: np.ndarray, right: dict[int, FloatArray]) -> list[FloatArray | None]:
    return [right.get(int(camera)) for camera in camera_of]


def suspicion_of(K: FloatArray, image_size: tuple[int, int]) -> Suspicion | None:
    """What is wrong with a K for images ``(height, width)``, as far as that shows in numbers."""
    height, width = image_size
    if not np.isfinite(K).all() or K[0, 0] <= 0 or K[1, 1] <= 0:
        focal = f"the focal lengths are {K[0, 0]:g} and {K[1, 1]:g} px"
        guess = usual_K(K, image_size)
        cure = f"calibrate the camera; many have about {in_a_line(guess)} for such images"
        return Suspicion(Fault.NONSENSE_CALIBRATION, focal, cure, guess)
    if abs(K[2, :2]).max() > 1 and abs(K[:2, 2]).max() < 1:
        evidence = f"the principal point ({K[2, 0]:g}, {K[2, 1]:g}) is in the last row"
        return Suspicion(Fault.K_TRANSPOSED, evidence, f"write K as {in_a_line(K.T)}", K.T.copy())
    relative, shape = max(K[0, 0], K[1, 1]) / max(image_size), K[1, 1] / K[0, 0]
    if not FOCAL[0] <= relative <= FOCAL[1] or not SHAPES[0] <= shape <= SHAPES[1]:
        evidence = (
            f"the focal lengths are {K[0, 0]:g} and {K[1, 1]:g} px for images of {width}x{height}, "
            f"{relative:.2g} times their longer side"
        )
        guess = usual_K(K, image_size)
        cure = f"calibrate the camera; many have about {in_a_line(guess)} for such images"
        return Suspicion(Fault.NONSENSE_CALIBRATION, evidence, cure, guess)
    return _of_other_images(K, image_size)


def _of_other_images(K: FloatArray, image_size: tuple[int, int]) -> Suspicion | None:
    height, width = image_size
    right, down = (K[0, 2] + 0.5) / width - 0.5, (K[1, 2] + 0.5) / height - 0.5
    point = f"the principal point ({K[0, 2]:.6g}, {K[1, 2]:.6g}) of images of {width}x{height}"
    if min(abs(right), abs(down)) <= CENTRAL:
        return None
    other = swapped(K)
    off = abs((other[0, 2] + 0.5) / width - 0.5), abs((other[1, 2] + 0.5) / height - 0.5)
    if right * down < 0 and max(off) < CENTRAL:
        evidence = f"{point} is in the middle of images of {height}x{width}"
        return Suspicion(Fault.SIDES_SWAPPED, evidence, f"write K as {in_a_line(other)}", other)
    factor = 0.5 / (0.5 + (right + down) / 2)
    if abs(right - down) < AGREEING and factor > 0:
        evidence = f"{point} is in the middle of images {1 / factor:.3g} times as large"
        # A principal point is in the middle within a few parts of a hundred.
        factor = common(factor, within=0.04)
        other = of_size(K, factor)
        cure = f"scale it: K times {factor:.4g} is {in_a_line(other)}"
        return Suspicion(Fault.K_OF_OTHER_SIZE, evidence, cure, other)
    if max(abs(right), abs(down)) > 0.5:
        evidence = f"{point} is outside of them"
        return Suspicion(Fault.NONSENSE_CALIBRATION, evidence, "calibrate the camera", None)
    return None


def usual_K(K: FloatArray, image_size: tuple[int, int]) -> FloatArray:
    """K of a usual lens, with the principal point where it is said to be, if that can be."""
    height, width = image_size
    x, y = K[0, 2], K[1, 2]
    central = abs((x + 0.5) / width - 0.5) < CENTRAL and abs((y + 0.5) / height - 0.5) < CENTRAL
    x, y = (x, y) if central else ((width - 1) / 2, (height - 1) / 2)
    focal = USUAL_FOCAL * max(image_size)
    return np.array([[focal, 0, x], [0, focal, y], [0, 0, 1]])


def in_a_line(K: FloatArray) -> str:
    """K as people read it.

    Example:
        >>> in_a_line(np.diag([500.0, 501.5, 1.0]))
        'fx 500 fy 501.5 cx 0 cy 0'
    """
    return f"fx {K[0, 0]:.6g} fy {K[1, 1]:.6g} cx {K[0, 2]:.6g} cy {K[1, 2]:.6g}"
