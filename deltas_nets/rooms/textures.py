"""An atlas of mip-mapped textures: what the surfaces of a drawn room look like.

Half of the textures are crops of the photographs that come inside the scikit-image
wheel (nothing is ever downloaded), the others are procedural. Scikit-image also ships
the Motorcycle stereo pair; our demo is evaluated on it, so it must not be seen here.
"""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import skimage
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from deltas_nets.rooms.patterns import PATTERNS

Array = NDArray[np.float64]

TEXTURE_SIZE = 256
LEVEL_SIZES = (256, 128, 64, 32, 16, 8)
TEXELS_PER_TEXTURE = sum(size * size for size in LEVEL_SIZES)
COPIES_PER_PATTERN = 12
CROPS_PER_PICTURE = 5
CROPS_PER_GROUND = 4

PICTURES = (
    "astronaut.png",
    "camera.png",
    "cell.png",
    "chelsea.png",
    "clock_motion.png",
    "coffee.png",
    "coins.png",
    "color.png",
    "hubble_deep_field.jpg",
    "ihc.png",
    "logo.png",
    "moon.png",
    "page.png",
    "retina.jpg",
    "rocket.jpg",
    "text.png",
)
GROUNDS = ("brick.png", "grass.png", "gravel.png")


class Atlas(NamedTuple):
    """All mip levels of all textures as one list of texels.

    Texture i starts at texel ``i * TEXELS_PER_TEXTURE``; its levels follow each other,
    ``LEVEL_SIZES`` wide and high, row by row. Textures repeat in both directions.
    """

    texels: Tensor
    """``(M, 3)`` uint8 RGB."""
    kinds: dict[str, tuple[int, ...]]
    """Which textures show what: "picture", "ground" or a name in ``PATTERNS``."""


@functools.cache
def texture_atlas(seed: int = 0) -> Atlas:
    """The atlas of a seed, drawn once per process (about a second).

    Args:
        seed: the same seed draws the same textures.
    """
    rng = np.random.default_rng(seed)
    painters: list[tuple[str, Callable[[np.random.Generator], Array]]] = []
    for kind, names, crops in (
        ("picture", PICTURES, CROPS_PER_PICTURE),
        ("ground", GROUNDS, CROPS_PER_GROUND),
    ):
        for name in names:
            picture = load_picture(name)
            painters += [(kind, functools.partial(_random_crop, picture))] * crops
    for kind, paint in PATTERNS.items():
        painters += [(kind, functools.partial(paint, size=TEXTURE_SIZE))] * COPIES_PER_PATTERN

    texels: list[NDArray[np.uint8]] = []
    kinds: dict[str, tuple[int, ...]] = {}
    for index, (kind, paint_one) in enumerate(painters):
        kinds[kind] = (*kinds.get(kind, ()), index)
        texels += [level.reshape(-1, 3) for level in _mip_levels(paint_one(rng))]
    return Atlas(torch.from_numpy(np.concatenate(texels)), kinds)


def load_picture(name: str) -> Image.Image:
    """A photograph from inside the scikit-image wheel, as RGB."""
    # Not skimage.data.<name>(): it would download what a wheel does not hold.
    path = Path(skimage.__file__).parent / "data" / name
    with Image.open(path) as picture:
        return picture.convert("RGB")


def _random_crop(picture: Image.Image, rng: np.random.Generator) -> Array:
    """A square part of a picture, possibly turned, mirrored and with channels swapped."""
    side = min(picture.size) * rng.uniform(0.35, 1.0)
    left, top = (rng.uniform(0, length - side) for length in picture.size)
    box = (left, top, left + side, top + side)
    size = (TEXTURE_SIZE, TEXTURE_SIZE)
    # A BOX filter averages when it shrinks; pictures are seldom enlarged.
    crop = np.asarray(picture.resize(size, Image.Resampling.BOX, box=box)) / 255.0
    if rng.random() < 0.5:
        crop = crop[:, ::-1]
    if rng.random() < 0.25:
        crop = np.rot90(crop)
    if rng.random() < 0.4:
        crop = crop[..., rng.permutation(3)]
    return crop


def _mip_levels(texture: Array) -> list[NDArray[np.uint8]]:
    """The texture at every level size; each level averages 2x2 texels of the one above."""
    levels = []
    for size in LEVEL_SIZES:
        if size < texture.shape[0]:
            texture = texture.reshape(size, 2, size, 2, 3).mean(axis=(1, 3))
        levels.append((texture.clip(0, 1) * 255).round().astype(np.uint8))
    return levels
