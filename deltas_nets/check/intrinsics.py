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

__all__ = ["Suspicion", "in_a_line", "off_middle", "suspicion_of", "wrong_intrinsics"]

FOCAL = (0.15, 20.0)
"""Of the longer side: an angle of view of 147 degrees, and one of 3."""
USUAL_FOCAL = 0.85
SHAPES = (0.6, 1.7)  # fy / fx
CENTRAL = 0.08  # parts of the image that a principal point is off the middle, if nobody cropped
AGREEING = 0.1  # relative, within which both axes tell of the same size
PARTS = (0.25, 0.75)  # of a side: where a principal point is, if it is written so
SQUARE = (0.9, 1.1)  # fy / fx of nearly all cameras


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
    centre = capture.form.centre
    suspicions = [suspicion_of(camera.K, camera.image_size, centre) for camera in arrays.cameras]
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
        of_frames = {place: right.get(int(camera)) for place, camera in enumerate(camera_of)}
        mend = changing_frames(with_K(of_frames)) if right else None
        yield Finding(cause, first.evidence, ids, first.cure, "error", mend)


def suspicion_of(
    K: FloatArray, image_size: tuple[int, int], centre: float = 0.0
) -> Suspicion | None:
    """What is wrong with a K, as far as that shows in numbers.

    Args:
        K: ``(3, 3)``, pixel centres at integers.
        image_size: (height, width).
        centre: where the file that states K has the centre of the first pixel.
    """
    if not np.isfinite(K).all() or K[0, 0] <= 0 or K[1, 1] <= 0:
        focal = f"the focal lengths are {K[0, 0]:g} and {K[1, 1]:g} px"
        guess = usual_K(K, image_size)
        cure = f"calibrate the camera; many have about {in_a_line(guess, centre)} for such images"
        return Suspicion(Fault.NONSENSE_CALIBRATION, focal, cure, guess)
    if abs(K[2, :2]).max() > 1 and abs(K[:2, 2]).max() < 1:
        evidence = f"the principal point ({K[2, 0]:g}, {K[2, 1]:g}) is in the last row"
        return Suspicion(Fault.K_TRANSPOSED, evidence, f"write K as {in_a_line(K.T)}", K.T.copy())
    return (
        _in_parts(K, image_size, centre)
        or _of_no_lens(K, image_size, centre)
        or _in_the_corner(K, image_size, centre)
        or _of_other_images(K, image_size, centre)
    )


def off_middle(K: FloatArray, image_size: tuple[int, int]) -> float:
    """How far the principal point is from the middle of the image, in parts of its sides."""
    height, width = image_size
    x, y = (K[0, 2] + 0.5) / width - 0.5, (K[1, 2] + 0.5) / height - 0.5
    return float(max(abs(x), abs(y)))


def _in_parts(K: FloatArray, image_size: tuple[int, int], centre: float) -> Suspicion | None:
    """K divided by the sides of the image, as some programs write it."""
    height, width = image_size
    stated = _moved(K, centre)
    right = _moved(np.diag([width, height, 1.0]) @ stated, -centre)
    inside = PARTS[0] <= min(stated[:2, 2]) and max(stated[:2, 2]) <= PARTS[1]
    square = SQUARE[0] <= right[1, 1] / right[0, 0] <= SQUARE[1]
    if not inside or not square or _of_no_lens(right, image_size, centre) is not None:
        return None
    evidence = f"{in_a_line(K, centre)} are parts of the sides of images of {width}x{height}"
    cure = f"multiply fx and cx by the width, fy and cy by the height: {in_a_line(right, centre)}"
    return Suspicion(Fault.NONSENSE_CALIBRATION, evidence, cure, right)


def _of_no_lens(K: FloatArray, image_size: tuple[int, int], centre: float) -> Suspicion | None:
    """Focal lengths too short, too long or too different."""
    height, width = image_size
    relative, shape = max(K[0, 0], K[1, 1]) / max(image_size), K[1, 1] / K[0, 0]
    if FOCAL[0] <= relative <= FOCAL[1] and SHAPES[0] <= shape <= SHAPES[1]:
        return None
    evidence = (
        f"the focal lengths are {K[0, 0]:g} and {K[1, 1]:g} px for images of {width}x{height}, "
        f"{relative:.2g} times their longer side"
    )
    guess = usual_K(K, image_size)
    cure = f"calibrate the camera; many have about {in_a_line(guess, centre)} for such images"
    return Suspicion(Fault.NONSENSE_CALIBRATION, evidence, cure, guess)


def _in_the_corner(K: FloatArray, image_size: tuple[int, int], centre: float) -> Suspicion | None:
    """A principal point that nobody stated, or that is in parts of the sides."""
    height, width = image_size
    if max(abs(K[:2, 2])) > 1:
        return None
    guess = K.copy()
    guess[:2, 2] = (width - 1) / 2, (height - 1) / 2
    evidence = (
        f"the principal point ({K[0, 2] + centre:.3g}, {K[1, 2] + centre:.3g}) is the corner of "
        f"images of {width}x{height}: cx and cy are 0, or parts of the sides"
    )
    x, y = guess[:2, 2] + centre
    cure = f"calibrate the camera; the middle is cx {x:g} cy {y:g}"
    return Suspicion(Fault.NONSENSE_CALIBRATION, evidence, cure, guess)


def _of_other_images(K: FloatArray, image_size: tuple[int, int], centre: float) -> Suspicion | None:
    height, width = image_size
    right, down = (K[0, 2] + 0.5) / width - 0.5, (K[1, 2] + 0.5) / height - 0.5
    x, y = K[:2, 2] + centre
    point = f"the principal point ({x:.6g}, {y:.6g}) of images of {width}x{height}"
    if min(abs(right), abs(down)) <= CENTRAL:
        return None
    other = swapped(K)
    off = abs((other[0, 2] + 0.5) / width - 0.5), abs((other[1, 2] + 0.5) / height - 0.5)
    if right * down < 0 and max(off) < CENTRAL:
        evidence = f"{point} is in the middle of images of {height}x{width}"
        cure = f"write K as {in_a_line(other, centre)}"
        return Suspicion(Fault.SIDES_SWAPPED, evidence, cure, other)
    ahead = min(right, down) > -0.5
    if ahead and abs(np.log((0.5 + right) / (0.5 + down))) < AGREEING:
        factor = 0.5 / (0.5 + (right + down) / 2)
        evidence = f"{point} is in the middle of images {1 / factor:.3g} times as large"
        # A principal point is in the middle within a few parts of a hundred.
        factor = common(factor, within=0.04)
        other = of_size(K, factor)
        cure = f"unless photos are cropped, scale it: K times {factor:.4g} is "
        cure += in_a_line(other, centre)
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


def _moved(K: FloatArray, shift: float) -> FloatArray:
    """K with its principal point moved, by as much on both axes."""
    moved = K.copy()
    moved[:2, 2] += shift
    return moved


def in_a_line(K: FloatArray, centre: float = 0.0) -> str:
    """K as people read it, in files that have the centre of the first pixel at ``centre``.

    Example:
        >>> in_a_line(np.diag([500.0, 501.5, 1.0]))
        'fx 500 fy 501.5 cx 0 cy 0'
    """
    x, y = K[:2, 2] + centre
    return f"fx {K[0, 0]:.6g} fy {K[1, 1]:.6g} cx {x:.6g} cy {y:.6g}"
