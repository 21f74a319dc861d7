"""Numbers as colours: scales with ticks, coloured images, and a bar that explains them."""

import math
from typing import NamedTuple

import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

__all__ = [
    "CONFIDENCE",
    "ERROR",
    "NONE",
    "Scale",
    "coloured",
    "depth_scale",
    "lookup_table",
    "ticks_of",
    "with_bar",
]

NONE = (128, 128, 128)
"""Where there is no value: a grey that no scale has."""
MOST_TICKS = 7
_DIGITS = ((1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8), (1, 1.5, 2, 3, 4, 5, 7), (1, 2, 5), (1, 3), (1,))
"""First digits of ticks, the finest that leaves few enough of them."""


class Scale(NamedTuple):
    """What a colour means.

    Attributes:
        palette: of matplotlib.
        low: the value of its first colour, and of what is below.
        high: the value of its last colour, and of what is above.
        unit: in a word; a per cent sign for shares.
        log: whether equal steps of colour are equal ratios.
    """

    palette: str
    low: float
    high: float
    unit: str
    log: bool = False

    def place(self, values: NDArray[np.floating]) -> NDArray[np.floating]:
        """Where values are between the first colour, 0, and the last, 1."""
        low, high = self.low, self.high
        if self.log:
            values = np.log(np.maximum(values, np.finfo(np.float32).tiny))
            low, high = math.log(low), math.log(high)
        place: NDArray[np.floating] = (values - low) / (high - low)
        return place


CONFIDENCE = Scale("viridis", 0, 100, "%")
"""Probability that the relative error is below 5 %."""
ERROR = Scale("magma", 0, 20, "%")
"""Relative error of depth."""


def depth_scale(depths: NDArray[np.float32], unit: str) -> Scale:
    """Turbo over what most of some depths span: near is red, far is blue.

    Args:
        depths: ``(N,)`` positive.
        unit: of them.
    """
    low, high = np.percentile(depths, (1, 99)) if len(depths) else (1.0, 10.0)
    middle, half = math.sqrt(low * high), max(math.sqrt(high / low), 1.1)
    return Scale("turbo_r", middle / half, middle * half, unit, log=True)


def lookup_table(scale: Scale) -> NDArray[np.uint8]:
    """``(256, 3)`` the colours from the low end to the high one."""
    colours = matplotlib.colormaps[scale.palette](np.arange(256), bytes=True)
    return np.ascontiguousarray(colours[:, :3])


def coloured(
    values: NDArray[np.float32], scale: Scale, *, known: NDArray[np.bool_] | None = None
) -> NDArray[np.uint8]:
    """``(H, W, 3)`` colours of values ``(H, W)``, grey where they are not known."""
    place = np.rint(255 * scale.place(values)).clip(0, 255).astype(np.uint8)
    colours: NDArray[np.uint8] = lookup_table(scale)[place]
    if known is not None:
        colours[~known] = NONE
    return colours


def ticks_of(scale: Scale) -> list[tuple[float, str]]:
    """Round values of a scale, as (place from 0 to 1, text).

    Example:
        >>> [text for _, text in ticks_of(Scale("turbo_r", 0.8, 6.0, "m", log=True))]
        ['1', '1.5', '2', '3', '4', '5']
        >>> [text for _, text in ticks_of(Scale("magma", 0, 20, "%"))]
        ['0', '5', '10', '15', '20']
    """
    values = _round_ratios(scale) if scale.log else []
    if len(values) < 3:
        values = _round_steps(scale)
    places = scale.place(np.array(values))
    return [(float(place), f"{value:g}") for place, value in zip(places, values, strict=True)]


def _round_ratios(scale: Scale) -> list[float]:
    first = math.floor(math.log10(scale.low))
    last = math.ceil(math.log10(scale.high))
    powers = range(first, last + 1)
    for digits in _DIGITS:
        found = [float(f"{d}e{p}") for p in powers for d in digits]
        found = [value for value in found if scale.low <= value <= scale.high]
        if len(found) <= MOST_TICKS:
            return found
    return found[:: math.ceil(len(found) / MOST_TICKS)]


def _round_steps(scale: Scale) -> list[float]:
    span = scale.high - scale.low
    power = 10.0 ** math.floor(math.log10(span))
    steps = [power * part for part in (0.2, 0.5, 1, 2)]
    step = next(step for step in steps if span / step < MOST_TICKS)
    counts = range(math.ceil(scale.low / step - 1e-9), math.floor(scale.high / step + 1e-9) + 1)
    return [round(count * step, 12) for count in counts]


def with_bar(picture: NDArray[np.uint8], scale: Scale) -> Image.Image:
    """A coloured picture above a bar that says what its colours mean."""
    height, width = picture.shape[:2]
    size = max(11, min(width // 40, 22))  # px of the letters
    whole = Image.new("RGB", (width, height + 3 * size), "white")
    whole.paste(Image.fromarray(picture), (0, 0))
    draw, font = ImageDraw.Draw(whole), ImageFont.load_default(size)
    left, right, top = size, width - size - round(draw.textlength(scale.unit, font)) - size, height
    across = np.linspace(0, 255, max(right - left, 2)).astype(int)
    bar = np.broadcast_to(lookup_table(scale)[across], (size, len(across), 3))
    whole.paste(Image.fromarray(np.ascontiguousarray(bar)), (left, top + size // 2))
    taken = -1.0
    for place, text in ticks_of(scale):
        x, half = left + place * (right - left), draw.textlength(text, font) / 2
        if x - half > taken:  # a narrow picture has no room for every number
            draw.text((x, top + 1.5 * size), text, "black", font, anchor="ma")
            taken = x + half + size / 3
    draw.text((right + size, top + size), scale.unit, "black", font, anchor="lm")
    return whole
