"""Whether depth is of the camera that the capture says, by depth alone and by its edges.

Depth of another focal length does not agree with itself from frame to frame: it is the best
evidence, for it needs no image. Where surfaces end, so do things in the image: that is sharper,
where depth has edges at all.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from skimage.filters import gaussian, sobel

from deltas_nets.captures.capture import Capture, Frame
from deltas_nets.captures.frame import FloatArray
from deltas_nets.check.finding import Fault, Finding, Mend
from deltas_nets.check.intrinsics import in_a_line
from deltas_nets.check.mending import changing_frames
from deltas_nets.check.rewrite import of_shape, with_focal
from deltas_nets.check.sensor import Sensor

__all__ = ["unregistered_depth"]

FACTORS = np.exp(np.linspace(-0.3, 0.3, 25))
LEAST_CHANGE = 0.05  # relative, of a focal length that is another camera's
_LEAST_GAIN = 0.95  # of the disagreement is left, at most
_VALLEY = 0.85  # of the disagreement at either end of the factors
_PIXELS = 1500  # of a frame, looked at
_JUMP = 0.08  # of depth, from a pixel to the one after the next: an edge
_EDGES = 100  # pixels of a frame
_SHARP = 1.2  # times the usual, the gradient of the image on edges of depth that are its own
KINECT = 585 / 525


class _Frame(NamedTuple):
    """A frame whose edges are compared.

    Attributes:
        strength: ``(H, W)`` of the image's edges, mean 1.
        sensor: with the depth.
    """

    strength: FloatArray
    sensor: Sensor


def unregistered_depth(
    capture: Capture, known: Mapping[int, Sensor], pairs: Sequence[tuple[int, int]]
) -> list[Finding]:
    """A finding where depth is of a longer or shorter lens than the capture says.

    Args:
        capture: whose poses are right.
        known: depth by position.
        pairs: positions of frames that see the same.
    """
    pairs = [pair for pair in pairs if pair[0] in known and pair[1] in known]
    alone = _by_depth(known, pairs)
    edges = _by_edges(capture, known)
    factor = edges or alone
    if factor is None or abs(np.log(factor)) <= LEAST_CHANGE:
        return []
    if alone is not None and edges is None and abs(np.log(alone)) <= LEAST_CHANGE:
        return []
    position = next(iter(known))
    K = known[position].K
    right = with_focal(K, factor)
    as_a_kinect = ", as of a Kinect's depth camera beside its colour camera (585 for 525 px)"
    kinect = as_a_kinect if abs(np.log(factor / KINECT)) < 0.03 else ""
    how = " and ".join(
        name for name, value in (("with itself", alone), ("with edges of images", edges)) if value
    )
    evidence = (
        f"depth agrees {how} best for a focal length of {right[0, 0]:.4g} px, {factor:.3g} times "
        f"the {K[0, 0]:.4g} px that the capture says{kinect}"
    )
    K_in_words = in_a_line(right, capture.form.centre)
    cure = (
        f"state the depth camera's intrinsics: {K_in_words} for depth of "
        f"{known[position].depth.shape[1]}x{known[position].depth.shape[0]} (in ScanNet's layout "
        "intrinsic/intrinsic_depth.txt), or register depth to the images"
    )
    return [
        Finding(
            Fault.DEPTH_NOT_REGISTERED,
            evidence,
            (),
            cure,
            "error",
            _with_depth_focal(known[position], factor),
        )
    ]


def _by_depth(known: Mapping[int, Sensor], pairs: Sequence[tuple[int, int]]) -> float | None:
    """The factor with which frames' depth agrees best; None where that tells nothing."""
    if len(pairs) < 3:
        return None
    costs = _Costs(lambda factor: _disagreement(known, pairs, factor))
    best = costs.best()
    # Cameras that hardly turn leave a valley without sides.
    sharp = costs(best) <= _VALLEY * min(costs(FACTORS[0]), costs(FACTORS[-1]))
    if not sharp or (abs(np.log(best)) > LEAST_CHANGE and costs(best) > _LEAST_GAIN * costs(1.0)):
        return None
    return best


class _Costs:
    """Costs of factors, each computed once."""

    def __init__(self, cost: Callable[[float], float]) -> None:
        self.cost, self.known = cost, dict[float, float]()

    def __call__(self, factor: float) -> float:
        if factor not in self.known:
            found = self.cost(factor)
            self.known[factor] = found if np.isfinite(found) else np.inf
        return self.known[factor]

    def best(self) -> float:
        """The factor of least cost, between those that are tried."""
        values = [self(float(factor)) for factor in FACTORS]
        place = int(np.argmin(values))
        if not 0 < place < len(values) - 1 or not np.isfinite(values[place - 1 : place + 2]).all():
            return float(FACTORS[place])
        before, least, after = values[place - 1 : place + 2]
        bend = before + after - 2 * least
        between = 0.5 * (before - after) / bend if bend > 0 else 0.0
        return float(FACTORS[place] * (FACTORS[1] / FACTORS[0]) ** between)


def _disagreement(
    known: Mapping[int, Sensor], pairs: Sequence[tuple[int, int]], factor: float
) -> float:
    """By how much depths of the same surface differ, relative, mean over pairs of the median."""
    found = []
    for one, other in pairs:
        a, b = known[one], known[other]
        step = max(1, int(np.sqrt(a.depth.size / _PIXELS)))
        rows, columns = np.mgrid[
            step // 2 : a.depth.shape[0] : step, step // 2 : a.depth.shape[1] : step
        ]
        z = a.depth[rows, columns].astype(np.float64)
        seen = z > 0
        pixels = np.stack([columns[seen], rows[seen], np.ones(int(seen.sum()))])
        points = np.linalg.inv(with_focal(a.K, factor)) @ pixels * z[seen]
        b_from_a = b.cam_from_world @ np.linalg.inv(a.cam_from_world)
        there = b_from_a[:3, :3] @ points + b_from_a[:3, 3:]
        ahead = there[2] > 1e-6
        x, y, w = with_focal(b.K, factor) @ np.where(ahead, there, 1.0)
        column, row = np.round(x / w), np.round(y / w)
        height, width = b.depth.shape
        inside = ahead & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        measured = b.depth[row[inside].astype(int), column[inside].astype(int)]
        both = measured > 0
        if both.sum() > 50:
            z_there = there[2][inside][both]
            found.append(float(np.median(abs(z_there - measured[both]) / z_there)))
    return float(np.mean(found)) if len(found) >= 3 else float("nan")


def _by_edges(capture: Capture, known: Mapping[int, Sensor]) -> float | None:
    """The factor with which edges of depth lie on edges of images; None where no place is sharp."""
    frames = [
        _Frame(_strength(capture.frames.at(position), sensor.depth.shape), sensor)
        for position, sensor in list(known.items())[::2][:12]
    ]
    edges = [(frame, _edges(frame.sensor)) for frame in frames]
    edges = [(frame, places) for frame, places in edges if len(places[0]) >= _EDGES]
    if len(edges) < 4:
        return None

    def cost(factor: float) -> float:
        return -float(np.mean([_on_edges(frame, places, factor) for frame, places in edges]))

    costs = _Costs(cost)
    best = costs.best()
    usual = float(np.median([-costs(float(factor)) for factor in FACTORS]))
    return best if -costs(best) >= _SHARP * usual and -costs(best) > _SHARP else None


def _strength(frame: Frame, size: tuple[int, ...]) -> FloatArray:
    grey = frame.read_resized((size[0], size[1])).mean(axis=-1)
    gradient = sobel(gaussian(grey, 1.5))
    # Strong edges count as edges, not for their strength.
    strength: FloatArray = gradient / (gradient + np.percentile(gradient, 80) + 1e-6)
    return strength / max(float(strength.mean()), 1e-6)


def _edges(sensor: Sensor) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns where one surface ends before another."""
    z = np.where(sensor.depth > 0, sensor.depth, np.nan)
    jump = np.zeros_like(z)
    for axis in (0, 1):
        one, other = np.roll(z, 1, axis), np.roll(z, -1, axis)
        jump = np.maximum(jump, np.nan_to_num(abs(one - other) / np.fmin(one, other)))
    jump[[0, -1]] = 0
    jump[:, [0, -1]] = 0
    rows, columns = np.nonzero(jump > _JUMP)
    return rows, columns


def _on_edges(
    frame: _Frame, places: tuple[NDArray[np.intp], NDArray[np.intp]], factor: float
) -> float:
    rows, columns = places
    pixels = np.stack([columns, rows, np.ones(len(rows))])
    x, y, w = frame.sensor.image_K @ np.linalg.inv(with_focal(frame.sensor.K, factor)) @ pixels
    height, width = frame.strength.shape
    column, row = np.round(x / w).astype(int), np.round(y / w).astype(int)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    # What lies outside of the image is on no edge, nor off one.
    found = frame.strength[row[inside], column[inside]]
    return float(found.mean()) if len(found) else 1.0


def _with_depth_focal(known: Sensor, factor: float) -> Mend:
    """All depth of the capture by another camera; that of frames not looked at is of the same."""

    def change(position: int, frame: Frame) -> Frame:
        if frame.depth_path is None:
            return frame
        size = frame.depth_size or (known.depth.shape[0], known.depth.shape[1])
        K = of_shape(frame.K, frame.image_size, size) if frame.depth_K is None else frame.depth_K
        return replace(frame, depth_K=with_focal(K, factor), depth_size=size)

    return changing_frames(change)
