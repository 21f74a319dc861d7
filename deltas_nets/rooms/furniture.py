"""Furniture as groups of solids, each drawn in a frame of its own.

That frame has y down, its origin on the floor below the middle, and its back towards
+z, so that against a wall +z points into the wall. No two visible faces of a group lie
in one plane, or rounding would decide, per pixel and per view, which of them is seen.
"""

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BOX, ELLIPSOID, CYLINDER = 0, 1, 2


class Solid(NamedTuple):
    """A box, an ellipsoid or an upright cylinder (axis along its y)."""

    shape: int
    centre: Array
    """``(3,)`` metres, in the frame of the group."""
    half_size: Array
    """``(3,)`` metres."""
    rotation: Array
    """``(3, 3)``, group frame from the solid's own axes."""
    material: str
    """A name in ``materials.MATERIALS``."""


def box(
    x: tuple[float, float], y: tuple[float, float], z: tuple[float, float], material: str
) -> Solid:
    """An axis-aligned box between the given limits in metres."""
    return _between(BOX, x, y, z, material)


def cylinder(x: float, z: float, radius: float, y: tuple[float, float], material: str) -> Solid:
    """An upright cylinder, ``y`` its limits."""
    return _between(CYLINDER, (x - radius, x + radius), y, (z - radius, z + radius), material)


def table(rng: np.random.Generator) -> list[Solid]:
    """A thin top on four legs, things on it."""
    w, d, h = rng.uniform((0.3, 0.25, 0.4), (0.9, 0.5, 0.8))
    thick, leg = rng.uniform((0.015, 0.012), (0.05, 0.035))
    solids = [box((-w, w), (-h, thick - h), (-d, d), "furniture")]
    solids += _legs(rng, w - 2 * leg, d - 2 * leg, leg, thick - h)
    return solids + clutter_on(rng, int(rng.integers(1, 6)), w, d, -h)


def chair(rng: np.random.Generator) -> list[Solid]:
    """Seat, back rest and legs."""
    w, d, h = rng.uniform((0.18, 0.18, 0.4), (0.26, 0.26, 0.55))
    back = rng.uniform(0.3, 0.6)
    solids = [box((-w, w), (-h, 0.04 - h), (-d, d), "furniture")]
    if rng.random() < 0.5:
        solids.append(box((-w, w), (-h - back, -h), (d - 0.03, d), "furniture"))
    else:  # bars
        solids.append(box((-w, w), (-h - back, 0.08 - h - back), (d - 0.03, d), "furniture"))
        for x in np.linspace(0.015 - w, w - 0.015, int(rng.integers(2, 5))):
            solids.append(cylinder(float(x), d - 0.015, 0.012, (-h - back, -h), "metal"))
    return solids + _legs(rng, w - 0.03, d - 0.03, 0.016, 0.04 - h)


def shelf(rng: np.random.Generator) -> list[Solid]:
    """Boards between two sides, rows of books on most of them."""
    w, d, h = rng.uniform((0.3, 0.12, 0.8), (0.8, 0.2, 2.1))
    boards = np.linspace(0.05, h, int(rng.integers(3, 6)))
    solids = [box((-w, w), (-h, 0.0), (d - 0.01, d), "furniture")]
    solids += [box((s * w - 0.015, s * w + 0.015), (-h, 0), (-d, d), "furniture") for s in (-1, 1)]
    solids += [
        box((-w, w), (-level - 0.01, 0.01 - level), (-0.97 * d, d), "furniture") for level in boards
    ]
    for level, above in itertools.pairwise(boards):
        if rng.random() < 0.75:
            left, right = -w + 0.02, w * rng.uniform(-0.3, 0.95)
            top = -level - (above - level) * rng.uniform(0.55, 0.9)
            solids.append(box((left, right), (top, -level), (rng.uniform(-0.9, 0) * d, d), "books"))
    return solids


def cabinet(rng: np.random.Generator) -> list[Solid]:
    """A closed box: cupboard, fridge, chest of drawers; things on the low ones."""
    w, d, h = rng.uniform((0.2, 0.15, 0.4), (0.7, 0.35, 2.0))
    solids = [box((-w, w), (-h, 0.0), (-d, d), "cabinet")]
    if h < 1.3:
        solids += clutter_on(rng, int(rng.integers(1, 5)), w, d, -h)
    return solids


def sofa(rng: np.random.Generator) -> list[Solid]:
    """Seat, back, arms and a cushion."""
    w, d, h = rng.uniform((0.4, 0.35, 0.35), (1.1, 0.45, 0.5))
    arm, top = rng.uniform(0.1, 0.2), -h - rng.uniform(0.3, 0.5)
    solids = [
        box((-w, w), (-h, 0.0), (-d, d), "cloth"),
        box((0.02 - w, w - 0.02), (top, -h), (d - 0.2, d), "cloth"),
        box((-w - 0.01, arm - w), (-h - 0.2, -0.02), (-d - 0.01, d), "cloth"),
        box((w - arm, w + 0.01), (-h - 0.2, -0.02), (-d - 0.01, d), "cloth"),
    ]
    x = rng.uniform(0.35 - w, w - 0.35) if w > 0.4 else 0.0
    cushion = _between(ELLIPSOID, (x - 0.22, x + 0.22), (-h - 0.4, -h), (0.0, d - 0.15), "cloth")
    return [*solids, cushion]


def lamp(rng: np.random.Generator) -> list[Solid]:
    """A pole with a shade: thin against whatever is behind."""
    h, radius, shade = rng.uniform((1.1, 0.008, 0.1), (1.9, 0.03, 0.25))
    shape = int(rng.choice((ELLIPSOID, CYLINDER)))
    return [
        cylinder(0.0, 0.0, radius, (-h, 0.0), "metal"),
        cylinder(0.0, 0.0, 6 * radius, (-0.03, 0.0), "metal"),
        _between(shape, (-shade, shade), (-h - shade, 0.6 * shade - h), (-shade, shade), "clutter"),
    ]


def hanging_lamp(rng: np.random.Generator) -> list[Solid]:
    """A shade on a cord from the ceiling, wherever that is."""
    w, h, bottom = rng.uniform((0.08, 0.05, 1.6), (0.35, 0.2, 2.3))
    shape = int(rng.choice((BOX, ELLIPSOID, CYLINDER)))
    cord = cylinder(0.0, 0.0, 0.008, (-4.0, -bottom), "metal")
    shade = "window" if rng.random() < 0.4 else "clutter"  # alight, or not
    return [cord, _between(shape, (-w, w), (-bottom - h, -bottom), (-w, w), shade)]


def plant(rng: np.random.Generator) -> list[Solid]:
    """A pot with leafy blobs, or with long leaves on all sides."""
    pot, h = rng.uniform((0.1, 0.2), (0.22, 0.5))
    solids = [cylinder(0.0, 0.0, pot, (-h, 0.0), "clutter")]
    if rng.random() < 0.5:
        stem = rng.uniform(0.2, 1.0)
        solids.append(cylinder(0.0, 0.0, 0.02, (-h - stem, -h), "foliage"))
        for _ in range(rng.integers(8, 36)):
            length, width = rng.uniform((0.12, 0.015), (0.35, 0.04))
            turn = rotation(yaw=rng.uniform(-np.pi, np.pi), pitch=rng.uniform(-0.6, 1.2))
            root = np.array([0.0, -h - rng.uniform(0.2, 1.0) * stem, 0.0])
            half = np.array([width, 0.006, length])
            solids.append(Solid(ELLIPSOID, root + turn[:, 2] * length, half, turn, "foliage"))
        return solids
    for _ in range(rng.integers(2, 6)):
        x, y, z = rng.uniform((-0.2, -h - 0.9, -0.2), (0.2, -h - 0.1, 0.2))
        half = rng.uniform(0.04, 0.25, 3)
        solids.append(Solid(ELLIPSOID, np.array([x, y, z]), half, _any_rotation(rng), "foliage"))
    return solids


def rack(rng: np.random.Generator) -> list[Solid]:
    """Bars between two posts, upright as of a railing or level as of a drying rack."""
    w, h, thin = rng.uniform((0.3, 0.7, 0.004), (0.9, 1.7, 0.018))
    solids = [cylinder(side * w, 0.0, 1.3 * thin, (-h, 0.0), "metal") for side in (-1, 1)]
    solids.append(box((-w, w), (-h - 2 * thin, -h), (-thin, thin), "metal"))
    count, low = int(rng.integers(3, 12)), rng.uniform(0.05, 0.4)
    if rng.random() < 0.5:
        solids.append(box((-w, w), (-low - 2 * thin, -low), (-thin, thin), "metal"))
        for x in np.linspace(-w, w, count + 2)[1:-1]:
            solids.append(cylinder(float(x), 0.0, thin, (-h, -low), "metal"))
        return solids
    for y in np.linspace(-h, -low, count + 1)[1:]:
        solids.append(box((-w, w), (float(y) - thin, float(y) + thin), (-thin, thin), "metal"))
    if rng.random() < 0.5:  # something hangs over it
        x, wide = rng.uniform((-0.5, 0.1), (0.5, 0.4)) * w
        solids.append(box((x - wide, x + wide), (-h - 0.03, -0.5 * h), (-0.03, 0.03), "cloth"))
    return solids


def column(rng: np.random.Generator) -> list[Solid]:
    """A pillar or pipe from the floor far up."""
    radius = rng.uniform(0.02, 0.2)
    if rng.random() < 0.5:
        return [cylinder(0.0, 0.0, radius, (-4.0, 0.0), "furniture")]
    return [box((-radius, radius), (-4.0, 0.0), (-radius, radius), "furniture")]


def poster(rng: np.random.Generator) -> list[Solid]:
    """A picture, screen or window hung on a wall, sometimes in a frame."""
    w, h = np.exp(rng.uniform(np.log(0.12), np.log(0.8), 2))
    middle, thick = -rng.uniform(1.1, 1.8), rng.uniform(0.005, 0.06)
    material = str(rng.choice(("picture", "picture", "screen", "window")))
    solids = [box((-w, w), (middle - h, middle + h), (-thick, 0.0), material)]
    if rng.random() < 0.5:
        rim = rng.uniform(0.01, 0.05)
        back = ((-w - rim, w + rim), (middle - h - rim, middle + h + rim), (-0.8 * thick, 0.0))
        solids.append(box(*back, "furniture"))
    return solids


def kitchen(rng: np.random.Generator) -> list[Solid]:
    """Cupboards below and above a worktop, a smooth panel between them, things on the top."""
    w, d, h = rng.uniform((0.6, 0.25, 0.8), (1.6, 0.32, 0.95))
    low, high = h + rng.uniform(0.4, 0.6), rng.uniform(1.9, 2.3)
    solids = [
        box((-w, w), (-h, 0.0), (-d, d), "cabinet"),
        box((-w - 0.01, w + 0.01), (-h - 0.04, -h), (-d - 0.02, d), "furniture"),
        box((-w, w), (-low, -h - 0.04), (d - 0.02, d), "panel"),
    ]
    shelf_depth = rng.uniform(0.0, 0.5) * d
    solids.append(box((-w, w), (-high, -low), (shelf_depth, d), "cabinet"))
    count = int(rng.integers(1, 4))
    for x in np.linspace(-w, w, count + 2)[1:-1]:  # handles
        handle = (float(x) - 0.06, float(x) + 0.06)
        solids.append(box(handle, (-h + 0.1, -h + 0.12), (-d - 0.03, -d), "metal"))
        bar = (shelf_depth - 0.03, shelf_depth)
        solids.append(box(handle, (-low - 0.12, -low - 0.1), bar, "metal"))
    return solids + clutter_on(rng, int(rng.integers(1, 5)), w, d - 0.05, -h - 0.04)


def door(rng: np.random.Generator) -> list[Solid]:
    """A door leaf in the plane of the wall."""
    w = rng.uniform(0.35, 0.5)
    handle = _between(ELLIPSOID, (0.8 * w, 0.92 * w), (-1.05, -0.99), (-0.09, -0.03), "metal")
    return [box((-w, w), (-2.05, 0.0), (-0.04, 0.0), "cabinet"), handle]


def clutter_on(rng: np.random.Generator, count: int, w: float, d: float, y: float) -> list[Solid]:
    """Boxes, bottles and balls on a surface at height ``y`` that spans +-w, +-d."""
    solids = []
    for _ in range(count):
        half = np.exp(rng.uniform(np.log(0.02), np.log(0.18), 3))
        shape = int(rng.choice((BOX, BOX, ELLIPSOID, CYLINDER)))
        x, z = rng.uniform((-w, -d), (w, d)) * 0.85
        turn = rotation(yaw=rng.uniform(-np.pi, np.pi)) if shape == BOX else np.eye(3)
        solids.append(Solid(shape, np.array([x, y - half[1], z]), half, turn, "clutter"))
    return solids


def floating(rng: np.random.Generator) -> list[Solid]:
    """One thing in the air, in any orientation, its centre at the origin.

    Nothing indoors does this, but a network must not learn that all things stand.
    """
    half = np.exp(rng.uniform(np.log(0.02), np.log(0.3), 3))
    shape = int(rng.choice((BOX, BOX, ELLIPSOID, CYLINDER)))
    turn = np.eye(3) if rng.random() < 0.3 else _any_rotation(rng)
    return [Solid(shape, np.zeros(3), half, turn, "clutter")]


def rotation(*, yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> Array:
    """Turn by roll about z, then by pitch about x, then by yaw about y, radians.

    With y down, positive yaw turns +z towards +x and positive pitch lifts it.
    """
    (cy, cp, cr), (sy, sp, sr) = np.cos((yaw, pitch, roll)), np.sin((yaw, pitch, roll))
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_x = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    about_z = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
    turn: Array = about_y @ about_x @ about_z
    return turn


def _any_rotation(rng: np.random.Generator) -> Array:
    yaw, pitch, roll = rng.uniform(-np.pi, np.pi, 3)
    return rotation(yaw=yaw, pitch=pitch, roll=roll)


def _between(
    shape: int,
    x: tuple[float, float],
    y: tuple[float, float],
    z: tuple[float, float],
    material: str,
) -> Solid:
    low, high = np.array([x, y, z], dtype=np.float64).T
    return Solid(shape, (low + high) / 2, (high - low) / 2, np.eye(3), material)


def _legs(rng: np.random.Generator, x: float, z: float, radius: float, top: float) -> list[Solid]:
    """Four legs, round or square, from ``top`` to the floor."""
    corners = [(sx * x, sz * z) for sx in (-1, 1) for sz in (-1, 1)]
    if rng.random() < 0.5:
        return [cylinder(cx, cz, radius, (top, 0.0), "metal") for cx, cz in corners]
    r = radius
    return [box((cx - r, cx + r), (top, 0.0), (cz - r, cz + r), "metal") for cx, cz in corners]
