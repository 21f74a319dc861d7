"""What a capture's own sparse points tell: half a pixel, and a scale that poses alone have.

Only they can: matches fit cameras as well with a pixel's half on or off, and in any unit.
"""

from collections.abc import Iterator

import numpy as np
import torch

from deltas_nets.captures.capture import Capture, Frame
from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.straight import lens_of
from deltas_nets.check.finding import Fault, Finding
from deltas_nets.check.mending import changing_frames, changing_poses
from deltas_nets.check.rewrite import moved_centre

__all__ = ["wrong_points"]

FRAMES = 24  # looked at
LEAST = 200  # observations
HALF = (0.35, 0.65)  # px by which all are off, on both axes alike
_SCALES = np.exp(np.linspace(np.log(1e-3), np.log(1e3), 121))
_FINER = np.exp(np.linspace(-0.06, 0.06, 41))
_MOST = 400  # observations of a frame
_FIT = 4.0  # px, within which observations are with the right scale, at least
_LEFT = 0.2  # of what observations are off as given, at most, with the right scale


def wrong_points(capture: Capture) -> list[Finding]:
    """A finding where observations of sparse points contradict cameras."""
    points = capture.points
    if points is None or len(points.seen.frame) < LEAST:
        return []
    seen = list(_seen(capture))
    off = _off(seen, 1.0)
    if len(off) < LEAST:
        return []
    usual = float(np.median(np.linalg.norm(off, axis=-1)))
    right, down = np.median(off, axis=0)
    if HALF[0] < abs(right) < HALF[1] and abs(right - down) < 0.15:
        return [_half(float(np.sign(right)) * 0.5, len(off))]
    if usual < _FIT:
        return []

    def cost(scale: float) -> float:
        return float(np.median(np.linalg.norm(_off(seen, scale), axis=-1)))

    rough = min(_SCALES, key=cost)
    best = float(min(rough * _FINER, key=cost))
    if cost(best) < min(_LEFT * usual, max(_FIT, 0.1 * usual)) and abs(np.log(best)) > 0.1:
        return [_scale(best, usual, cost(best))]
    return []


def _seen(capture: Capture) -> Iterator[tuple[Frame, FloatArray, FloatArray]]:
    """Frames, points in the world and the pixels that see them."""
    points = capture.points
    assert points is not None
    for position in np.unique(np.linspace(0, len(capture.frames) - 1, FRAMES).round().astype(int)):
        mine = np.flatnonzero(points.seen.frame == position)
        mine = mine[:: max(1, len(mine) // _MOST)]
        if len(mine):
            frame = capture.frames.at(int(position))
            yield frame, points.xyz[points.seen.point[mine]], points.seen.pixels[mine]


def _off(seen: list[tuple[Frame, FloatArray, FloatArray]], scale: float) -> FloatArray:
    """``(T, 2)`` px from where points project, with translations multiplied, to observations."""
    found = [np.zeros((0, 2))]
    for frame, xyz, pixels in seen:
        pose = frame.cam_from_world
        points = xyz @ pose[:3, :3].T + scale * pose[:3, 3]
        ahead = points[:, 2] > 0
        projected = lens_of(frame).project(torch.from_numpy(points)).pixels.numpy()
        off = np.where(ahead[:, None] & np.isfinite(projected), pixels - projected, 1e6)
        found.append(off)
    everything: FloatArray = np.concatenate(found)
    return everything


def _half(shift: float, count: int) -> Finding:
    evidence = f"{count} observations of sparse points are {shift:+g} px off on both axes (median)"
    cure = f"add {shift:+g} to cx and cy: pixel centres are whole numbers here, halves in COLMAP"
    mend = changing_frames(lambda _, frame: moved_centre(frame, shift))
    return Finding(Fault.HALF_A_PIXEL, evidence, (), cure, "warning", mend)


def _scale(factor: float, given: float, after: float) -> Finding:
    evidence = (
        f"sparse points fit poses whose translations are {factor:.3g} times as long: they are "
        f"{after:.2g} px off then, {given:.3g} px as given"
    )
    cure = f"multiply the translations of poses by {factor:.3g}, or the points by {1 / factor:.3g}"

    def change(poses: FloatArray) -> FloatArray:
        poses[:, :3, 3] *= factor
        return poses

    return Finding(Fault.WRONG_SCALE, evidence, (), cure, "error", changing_poses(change))
