"""What disturbs a network, by how much: the steps of each robustness curve."""

import hashlib
from collections.abc import Callable

import numpy as np

from deltas_nets.ablations.changes import (
    FrameChange,
    blurred,
    calibrated_wrong,
    exposed,
    moved,
    turned,
)
from deltas_nets.ablations.disturbed import Disturbed, InUnit
from deltas_nets.ablations.steps import Series, Step
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.config.varied import NetworkSettings
from deltas_nets.predict.predictor import Predictor

__all__ = ["CURVES", "MOST_VIEWS", "curve"]

MOST_VIEWS = 8
_CENTIMETRES = (0.0, 0.5, 1.0, 2.0, 3.0, 5.0)
_DEGREES = (0.0, 0.1, 0.25, 0.5, 1.0, 2.0)
_FOCAL = (-5.0, -2.0, -1.0, 0.0, 1.0, 2.0, 5.0)  # per cent
_BLUR = (0.0, 0.1, 0.2, 0.4, 0.8)  # per cent of the width
_STOPS = (0.0, 0.5, 1.0, 1.5, 2.0)
_UNITS = (0.01, 0.1, 0.5, 1.0, 2.0, 10.0, 1000.0)  # in a metre
_RANGES = ((0.5, 5.0), (0.5, 10.0), (0.5, 20.0), (0.25, 10.0), (0.25, 20.0), (0.1, 50.0))
_ORDERS = 5


def curve(name: str, seed: int = 0) -> Series:
    """A curve's steps.

    Args:
        name: of :data:`CURVES`.
        seed: of the directions in which frames err.

    Raises:
        KeyError: there is no such curve.
    """
    return _MAKERS[name](seed)


def _posed(change: Callable[[float], FrameChange], name: str, value: float) -> Step:
    """Of cameras and poses: what is known of the images stays true."""
    return Step(name, value, lambda predictor: Disturbed(predictor, change(value)))


def _imaged(change: Callable[[float], FrameChange], name: str, value: float) -> Step:
    """Of images: a network of its own, as encoders remember frames by their files."""

    def disturb(predictor: Predictor) -> Predictor:
        return Disturbed(predictor.varied(NetworkSettings()), change(value))

    return Step(name, value, disturb)


def _translation(seed: int) -> Series:
    steps = (_posed(lambda cm: moved(cm / 100, seed), f"{cm:g}", cm) for cm in _CENTIMETRES)
    title = "cameras moved, each in a direction of its own"
    return Series("translation", title, "error of position, cm", tuple(steps))


def _rotation(seed: int) -> Series:
    steps = (_posed(lambda degrees: turned(degrees, seed), f"{d:g}", d) for d in _DEGREES)
    title = "cameras turned, each about an axis of its own"
    return Series("rotation", title, "error of orientation, degrees", tuple(steps))


def _calibration(_: int) -> Series:
    steps = (_posed(lambda p: calibrated_wrong(p / 100), f"{p:+g}", p) for p in _FOCAL)
    title = "focal length of all frames wrong"
    return Series("calibration", title, "error of the focal length, %", tuple(steps))


def _blur(_: int) -> Series:
    steps = (_imaged(lambda p: blurred(p / 100), f"{p:g}", p) for p in _BLUR)
    return Series("blur", "images blurred", "deviation of the blur, % of the width", tuple(steps))


def _exposure(seed: int) -> Series:
    steps = (_imaged(lambda stops: exposed(stops, seed), f"{s:g}", s) for s in _STOPS)
    title = "light of each image changed by up to so many stops"
    return Series("exposure", title, "largest change of exposure, stops", tuple(steps))


def _views(_: int) -> Series:
    def first(count: int) -> Callable[[ViewSet], ViewSet]:
        return lambda views: views._replace(sources=views.sources[: count - 1])

    steps = (Step(str(v), v, views=first(v)) for v in range(2, MOST_VIEWS + 1))
    return Series("views", "number of views", "views, the anchor included", tuple(steps))


def _order(seed: int) -> Series:
    def mixed(turn: int) -> Callable[[ViewSet], ViewSet]:
        def change(views: ViewSet) -> ViewSet:
            key = hashlib.sha256(f"{seed} {turn} {views.anchor}".encode()).digest()
            order = np.random.default_rng(int.from_bytes(key[:8], "little"))
            sources = [views.sources[n] for n in order.permutation(len(views.sources))]
            return views._replace(sources=tuple(sources))

        return change

    steps = (Step(str(n), n, views=mixed(n)) for n in range(1, _ORDERS))
    title = "sources in another order"
    return Series("order", title, "number of the order", (Step("0", 0), *steps))


def _units(_: int) -> Series:
    def step(factor: float, *, told: bool) -> Step:
        name = f"{factor:g}" + ("" if told else ", not told")
        value = factor if told else None
        return Step(name, value, lambda predictor: InUnit(predictor, factor, told=told))

    told = (step(factor, told=True) for factor in _UNITS)
    untold = (step(factor, told=False) for factor in (0.5, 2.0))
    title = "the world in another unit, the network told or not"
    return Series("units", title, "units in a metre", (*told, *untold), logarithmic=True)


def _depth_range(_: int) -> Series:
    steps = (
        Step(f"{near:g} to {far:g} m", far / near, search=(near, far)) for near, far in _RANGES
    )
    title = "range of depth that is searched; the truth that is scored stays"
    return Series("depth-range", title, "", tuple(steps))


_MAKERS: dict[str, Callable[[int], Series]] = {
    "translation": _translation,
    "rotation": _rotation,
    "calibration": _calibration,
    "blur": _blur,
    "exposure": _exposure,
    "views": _views,
    "order": _order,
    "units": _units,
    "depth-range": _depth_range,
}
CURVES = tuple(_MAKERS)
"""Names that the command takes."""
