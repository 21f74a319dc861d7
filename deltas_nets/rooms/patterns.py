"""Procedural textures: plaster, wood, tiles, cloth, books, print and clutter.

Each function takes a generator and a size in texels and returns a ``(size, size, 3)``
picture with values around [0, 1]. Most of them repeat without a seam.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

Array = NDArray[np.float64]


def fractal_noise(rng: np.random.Generator, *, size: int, falloff: float) -> Array:
    """Periodic noise in [0, 1] whose amplitude falls as ``frequency ** -falloff``."""
    frequency = np.fft.fftfreq(size)
    radius = np.hypot(frequency[:, None], frequency)
    radius[0, 0] = 1.0
    spectrum = rng.normal(size=(size, size)) + 1j * rng.normal(size=(size, size))
    noise: Array = np.fft.ifft2(spectrum / radius**falloff).real
    low, high = np.quantile(noise, (0.005, 0.995))
    unit: Array = ((noise - low) / (high - low)).clip(0, 1)
    return unit


def plaster(rng: np.random.Generator, *, size: int) -> Array:
    """Grey noise around one half; surfaces that use it choose a weak contrast."""
    noise = fractal_noise(rng, size=size, falloff=rng.uniform(0.5, 2.0))
    return np.repeat(noise[..., None], 3, axis=-1)


def clouds(rng: np.random.Generator, *, size: int) -> Array:
    """Coloured noise: stone, carpet, cloth, foliage."""
    return _colour_map(rng, fractal_noise(rng, size=size, falloff=rng.uniform(0.6, 2.2)))


def wood(rng: np.random.Generator, *, size: int) -> Array:
    """Grain along y, sometimes cut into planks."""
    x = np.arange(size) / size
    bend = rng.uniform(0.3, 2.0) * fractal_noise(rng, size=size, falloff=2.2)
    rings = 0.5 + 0.5 * np.sin(2 * np.pi * (bend + rng.integers(3, 14) * x))
    grain = 0.6 * rings + 0.4 * fractal_noise(rng, size=size, falloff=1.2)
    light, dark = rng.uniform((0.5, 0.3, 0.15), (0.9, 0.7, 0.5)), rng.uniform(0.3, 0.8)
    colour = light * (dark + (1 - dark) * grain[..., None])
    if rng.random() < 0.5:
        planks = rng.integers(2, 7)
        colour *= rng.uniform(0.75, 1.0, planks)[(x * planks).astype(int)][None, :, None]
        colour[:, (x * planks) % 1 < 0.03] *= 0.5
    return colour


def tiles(rng: np.random.Generator, *, size: int) -> Array:
    """Bricks or tiles with joints; the same stone again and again."""
    y, x = np.mgrid[:size, :size] / size
    rows, columns = rng.integers(2, 8, size=2)
    if rng.random() < 0.5:  # a running bond needs an even number of rows to repeat
        rows = 2 * rows
        x = x + 0.5 / columns * (np.floor(y * rows) % 2)
    width = rng.uniform(0.02, 0.08)
    joint = ((x * columns) % 1 < width) | ((y * rows) % 1 < width * rows / columns)
    stone = 0.5 + rng.uniform(0.05, 0.5) * fractal_noise(rng, size=size, falloff=1.5)
    return _colour_map(rng, np.where(joint, 0.0, stone))


def checks(rng: np.random.Generator, *, size: int) -> Array:
    """Checkerboards, stripes and plaids."""
    y, x = np.mgrid[:size, :size] / size
    across, down = rng.integers(1, 9, size=2)
    a, b = np.floor(2 * across * x) % 2, np.floor(2 * down * y) % 2
    value = (np.abs(a - b), a, 0.5 * (a + b))[rng.integers(3)]
    noise = fractal_noise(rng, size=size, falloff=1.2)
    return _colour_map(rng, 0.8 * value + 0.2 * noise)


def books(rng: np.random.Generator, *, size: int) -> Array:
    """A row of book spines, each with a title and a band or two."""
    colour = np.full((size, size, 3), 0.08)
    left = 0
    while left < size:
        right = left + int(rng.integers(8, 34))
        top = int(rng.integers(0, size // 4))
        spine = rng.uniform(0.1, 0.95, 3) * rng.uniform(0.5, 1.0)
        rounding = 1 - 0.4 * np.linspace(-1, 1, right - left) ** 2
        visible = colour[top:, left:right].shape[1]
        colour[top:, left:right] = (spine * rounding[:, None])[:visible]
        for _ in range(rng.integers(1, 4)):
            start = int(rng.integers(top + 5, size - 30))
            stop = start + int(rng.integers(3, 60))
            colour[start:stop, left + 3 : right - 3] = rng.uniform(0, 1, 3)
        left = right
    return colour


def print_(rng: np.random.Generator, *, size: int) -> Array:
    """Lines of strokes that look like writing from a distance."""
    paper = rng.uniform(0.6, 1.0) * rng.uniform(0.85, 1.0, 3)
    page = Image.new("RGB", (size, size), _rgb(paper))
    draw = ImageDraw.Draw(page)
    ink = _rgb(rng.uniform(0, 0.4, 3))
    height = int(rng.integers(5, 16))
    width = max(3, int(height * 0.6))
    for top in range(height, size - height, int(height * rng.uniform(1.5, 2.2))):
        for left in range(8, int(size * rng.uniform(0.5, 1.0)) - width, width + 2):
            if rng.random() < 0.17:  # a space between words
                continue
            strokes = rng.integers(0, (width, height), size=(3, 2)) + np.array((left, top))
            draw.line([(int(x), int(y)) for x, y in strokes], fill=ink)
    return np.asarray(page) / 255.0


def rectangles(rng: np.random.Generator, *, size: int) -> Array:
    """Overlapping filled and empty rectangles: doors, panels, screens, packaging."""
    background, *colours = _palette(rng, int(rng.integers(9, 50)))
    canvas = Image.new("RGB", (size, size), _rgb(background))
    draw = ImageDraw.Draw(canvas)
    for colour in map(_rgb, colours):
        left, top = (int(start) for start in rng.integers(0, size, 2))
        right, bottom = left + int(rng.integers(4, 80)), top + int(rng.integers(4, 80))
        filled = rng.random() < 0.7
        draw.rectangle((left, top, right, bottom), fill=colour if filled else None, outline=colour)
    return np.asarray(canvas) / 255.0


def cells(rng: np.random.Generator, *, size: int) -> Array:
    """A Voronoi diagram on the torus: edges in all directions, flat in between."""
    grid = np.arange(size) / size
    seeds = rng.uniform(0, 1, (int(rng.integers(10, 60)), 2, 1))
    gap = np.abs(grid - seeds)
    squared = np.minimum(gap, 1 - gap) ** 2  # wraps around
    nearest = (squared[:, 0, :, None] + squared[:, 1, None, :]).argmin(axis=0)
    picture: Array = _palette(rng, len(seeds))[nearest]
    return picture


PATTERNS: Mapping[str, Callable[..., Array]] = MappingProxyType(
    {
        "plaster": plaster,
        "clouds": clouds,
        "wood": wood,
        "tiles": tiles,
        "checks": checks,
        "books": books,
        "print": print_,
        "rectangles": rectangles,
        "cells": cells,
    }
)


def _colour_map(rng: np.random.Generator, value: Array) -> Array:
    """Map values in [0, 1] to a random path through two to four colours."""
    colours = _palette(rng, int(rng.integers(2, 5)))
    stops = np.linspace(0, 1, len(colours))
    return np.stack([np.interp(value, stops, channel) for channel in colours.T], axis=-1)


def _palette(rng: np.random.Generator, count: int) -> Array:
    """``(count, 3)`` colours, as vivid as each other: most things indoors are greyish."""
    vivid = rng.uniform(0, 1) ** 1.5
    colours: Array = vivid * rng.uniform(0, 1, (count, 3)) + (1 - vivid) * rng.uniform(
        0, 1, (count, 1)
    )
    return colours


def _rgb(colour: Array) -> tuple[int, int, int]:
    red, green, blue = (round(255 * float(channel)) for channel in colour)
    return red, green, blue
