"""Lenses that no one grinds: distortion that folds the image, or is larger than it."""

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import Frame, Lens
from deltas_nets.captures.frames import FrameArrays
from deltas_nets.captures.straight import straight
from deltas_nets.check.finding import Fault, Finding, Mend
from deltas_nets.check.mending import changing_frames

__all__ = ["wrong_lenses"]

MOST = 1.0  # of the first radial coefficient
RADIAL = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")


def wrong_lenses(capture: Capture) -> list[Finding]:
    """A finding for the cameras whose lens is nonsense."""
    arrays = capture.frames.arrays
    wrong: dict[int, str] = {}
    for camera, kind in enumerate(arrays.cameras):
        members = np.flatnonzero(arrays.camera_of == camera)
        if kind.lens is None or not len(members):
            continue
        why = _why(kind.lens)
        if why is None:
            try:
                straight(capture.frames.at(int(members[0])))
            except (ValueError, ArithmeticError, RuntimeError, IndexError):
                why = "hardly a pixel of the image has a ray"
        if why is not None:
            numbers = " ".join(f"{number:g}" for number in kind.lens.coefficients)
            wrong[camera] = f"{why} ({kind.lens.model} {numbers})"
    if not wrong:
        return []
    mask = np.isin(arrays.camera_of, list(wrong))
    ids = () if mask.all() else tuple(capture.frames.kept(mask))
    cure = "calibrate the lens; if images are undistorted already, state no lens"
    evidence = next(iter(wrong.values()))
    return [
        Finding(Fault.NONSENSE_LENS, evidence, ids, cure, "error", _without_lens(arrays, wrong))
    ]


def _why(lens: Lens) -> str | None:
    if not all(map(np.isfinite, lens.coefficients)):
        return "a coefficient is not finite"
    if lens.model in RADIAL and abs(lens.coefficients[0]) > MOST:
        return f"k1 is {lens.coefficients[0]:g}; lenses are within -0.6 to 0.6"
    return None


def _without_lens(arrays: FrameArrays, wrong: Collection[int]) -> Mend:
    cameras = arrays.camera_of

    def change(position: int, frame: Frame) -> Frame:
        return replace(frame, lens=None) if int(cameras[position]) in wrong else frame

    return changing_frames(change)
