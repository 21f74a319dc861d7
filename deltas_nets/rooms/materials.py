"""What the surfaces of a room are made of: which texture, how large, how strong, how bright."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from deltas_nets.rooms.furniture import Solid

GLOSS_RANGE = (0.03, 0.6)  # polished wood to a mirror
ROUGHNESS_RANGE = (0.003, 0.15)  # rad


class Surfaces(NamedTuple):
    """How the faces look: -x, +x, -y, +y, -z, +z of each solid, in its own axes.

    A texture is read at ``scale * (u, v) + offset``, where u, v are metres along the
    face: (z, y), (x, z) or (x, y). Albedo is ``tint * (0.5 + contrast * (texture - 0.5))``.
    """

    texture: Tensor
    """``(N, 6)`` int64, into the atlas."""
    scale: Tensor
    """``(N, 6, 2)`` repetitions per metre."""
    offset: Tensor
    """``(N, 6, 2)`` repetitions."""
    tint: Tensor
    """``(N, 6, 3)`` RGB."""
    contrast: Tensor
    """``(N, 6)``."""
    shade: Tensor
    """``(N, 7)`` soft shadows: frequency (3) in rad/m and phase (3) along x, y and z of
    the solid, and depth (1) in [0, 1)."""
    gloss: Tensor
    """``(N, 6)`` share of the light that the face mirrors, seen head-on; 0 is matte."""
    roughness: Tensor
    """``(N,)`` how blurred it mirrors, radians."""


class Material(NamedTuple):
    """What textures a surface may have and how large and strong they are."""

    kinds: tuple[str, ...]
    """Kinds of texture in the atlas, equally likely."""
    repeat: tuple[float, float]
    """Metres that one repetition covers, drawn log-uniformly; unused where ``fit``."""
    contrast: tuple[float, float]
    """Drawn log-uniformly."""
    fit: bool = False
    """Stretch one copy of the texture over each face."""
    saturation: float = 0.2
    """How far tints may be from grey."""
    brightness: tuple[float, float] = (0.5, 1.7)
    """Of the tint."""
    glossy: float = 0.0
    """Share of the surfaces that mirror their surroundings: lacquer, tiles, glass, polish."""


MATERIALS: Mapping[str, Material] = MappingProxyType(
    {
        "plain wall": Material(
            ("plaster", "plaster", "clouds"),
            (0.5, 3.0),
            (0.015, 0.2),
            saturation=0.12,
            glossy=0.08,
        ),
        "papered wall": Material(
            ("tiles", "checks", "ground", "clouds"), (0.4, 2.0), (0.1, 0.8), glossy=0.15
        ),
        "floor": Material(
            ("wood", "tiles", "ground", "clouds", "checks"), (0.6, 2.5), (0.15, 1.0), glossy=0.3
        ),
        "furniture": Material(
            ("wood", "wood", "plaster", "clouds"), (0.4, 2.0), (0.05, 1.0), glossy=0.4
        ),
        "cabinet": Material(
            ("wood", "plaster", "plaster", "rectangles"), (0.4, 2.0), (0.02, 0.9), glossy=0.5
        ),
        "panel": Material(
            ("plaster", "tiles", "clouds"), (0.3, 1.5), (0.01, 0.5), saturation=0.8, glossy=0.9
        ),
        "cloth": Material(("clouds", "checks", "plaster", "cells"), (0.2, 1.2), (0.1, 0.9)),
        "metal": Material(("plaster", "clouds"), (0.2, 1.0), (0.05, 0.5), glossy=0.7),
        "books": Material(("books",), (0.35, 0.8), (0.7, 1.1)),
        "picture": Material(
            ("picture", "picture", "print", "rectangles", "cells"),
            (1.0, 1.0),
            (0.5, 1.1),
            fit=True,
            glossy=0.3,
        ),
        "screen": Material(("plaster",), (0.5, 2.0), (0.01, 0.1), brightness=(0.02, 0.2), glossy=1),
        "window": Material(
            ("picture", "clouds"), (1.0, 1.0), (0.3, 1.0), fit=True, brightness=(2.0, 6.0)
        ),
        "clutter": Material(
            ("picture", "rectangles", "print", "clouds", "cells"),
            (0.15, 0.8),
            (0.3, 1.1),
            glossy=0.2,
        ),
        "foliage": Material(("ground", "clouds"), (0.2, 0.6), (0.5, 1.1), saturation=0.6),
    }
)


def draw_surfaces(
    rng: np.random.Generator, solids: list[Solid], kinds: Mapping[str, tuple[int, ...]]
) -> Surfaces:
    """Choose what every face looks like.

    Args:
        rng: all randomness comes from here.
        solids: N of them, the room first.
        kinds: textures by what they show, as in ``Atlas.kinds``.
    """
    count = len(solids)
    texture: NDArray[np.int64] = np.zeros((count, 6), dtype=np.int64)
    scale, offset = np.ones((count, 6, 2)), rng.uniform(0, 1, (count, 6, 2))
    tint, contrast = np.ones((count, 6, 3)), np.ones((count, 6))
    gloss = np.zeros((count, 6))
    walls = ["papered wall" if rng.random() < 0.33 else "plain wall" for _ in range(6)]
    walls[3] = "floor"
    if rng.random() < 0.6:  # all four walls alike
        walls[0] = walls[1] = walls[4] = walls[5]
    for n, solid in enumerate(solids):
        # Tables and shelves are of one piece; so are their legs and boards.
        alike = n > 0 and rng.random() < 0.7
        like_last = n > 1 and solid.material == solids[n - 1].material != "clutter"
        if like_last and solid.material != "picture" and rng.random() < 0.85:
            for values in (texture, scale, tint, contrast, gloss):
                values[n] = values[n - 1]
            continue
        for face in range(6):
            if face > 0 and alike:
                texture[n, face], tint[n, face] = texture[n, 0], tint[n, 0]
                contrast[n, face], scale[n, face] = contrast[n, 0], scale[n, 0]
                gloss[n, face] = gloss[n, 0]
            else:
                material = MATERIALS[walls[face] if n == 0 else solid.material]
                # One in eight surfaces is of something else, so that textures tell no shape.
                odd = n > 0 and rng.random() < 0.12
                options = tuple(kinds) if odd else material.kinds
                kind = options[rng.integers(len(options))]
                texture[n, face] = rng.choice(kinds[kind])
                scale[n, face] = np.exp(-rng.uniform(*np.log(material.repeat)))
                contrast[n, face] = np.exp(rng.uniform(*np.log(material.contrast)))
                grey = rng.uniform(*material.brightness)
                tint[n, face] = grey * (1 + material.saturation * rng.uniform(-1, 0.3, 3))
                if rng.random() < material.glossy:
                    gloss[n, face] = np.exp(rng.uniform(*np.log(GLOSS_RANGE)))
                    # Dark lacquer and glass show their own colour least.
                    if rng.random() < 0.5:
                        tint[n, face] *= rng.uniform(0.05, 0.6)
            if MATERIALS[solid.material].fit:
                u, v = ((2, 1), (0, 2), (0, 1))[face // 2]
                scale[n, face] = 0.5 / solid.half_size[[u, v]]
                offset[n, face] = 0.5
    if rng.random() < 0.5:  # walls of one colour
        tint[0, [0, 1, 4, 5]], gloss[0, [0, 1, 4, 5]] = tint[0, 0], gloss[0, 0]
    frequency = rng.uniform(0.4, 8.0, (count, 3)) * rng.choice((1.0, 0.35), (count, 1))
    phase, depth = rng.uniform(0, 2 * np.pi, (count, 3)), rng.uniform(0, 0.4, (count, 1))
    shade = np.concatenate([frequency, phase, depth], axis=1)
    smooth, rough = np.log(ROUGHNESS_RANGE)
    roughness = np.exp(rng.uniform(smooth, rough, count))
    looks = (scale, offset, tint, contrast, shade, gloss, roughness)
    return Surfaces(
        torch.from_numpy(texture), *(torch.from_numpy(values).float() for values in looks)
    )
