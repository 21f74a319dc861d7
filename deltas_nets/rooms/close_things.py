"""What cameras come close to: desks with all that lies on them, shelves of small things, floors.

In the frames of :mod:`deltas_nets.rooms.furniture`: y down, the back towards +z.
"""

import itertools

import numpy as np
from numpy.typing import NDArray

from deltas_nets.rooms.furniture import BOX, CYLINDER, ELLIPSOID, Solid, box, cylinder, rotation

Array = NDArray[np.float64]


def desk(rng: np.random.Generator) -> list[Solid]:
    """A desk seen from where one sits or stands: screens, keyboard, papers, books, cables."""
    w, d, h = rng.uniform((0.45, 0.28, 0.68), (0.9, 0.45, 0.78))
    thick = rng.uniform(0.015, 0.04)
    solids = [box((-w, w), (-h, thick - h), (-d, d), "furniture")]
    for side in (-1, 1):
        leg = (side * (w - 0.06), side * (w - 0.06) + 0.04)
        if rng.random() < 0.5:
            solids.append(box(leg, (thick - h, 0.0), (-d + 0.03, d - 0.03), "furniture"))
        else:
            solids += [
                cylinder(leg[0], s * (d - 0.05), 0.02, (thick - h, 0), "metal") for s in (-1, 1)
            ]
    for x in rng.permutation(np.array([-0.5, 0.0, 0.5]))[: rng.integers(0, 3)]:
        solids += _screen(rng, float(x) * w, d - rng.uniform(0.08, 0.2), -h)
    if rng.random() < 0.7:
        solids += _keyboard(rng, rng.uniform(-0.4, 0.4) * w, -d + rng.uniform(0.1, 0.2), -h)
    solids += _things(rng, int(rng.integers(5, 22)), w, d, -h)
    solids += [
        thing
        for _ in range(rng.integers(0, 4))
        for thing in _cable(rng, rng.uniform((-w, -h - 0.006, -d), (w, -h - 0.003, d)))
    ]
    return solids


def bins(rng: np.random.Generator) -> list[Solid]:
    """One or more compartments of a shelf, as a robot or a shopper looks into them."""
    w, d = rng.uniform((0.2, 0.15), (0.6, 0.28))
    bottom = rng.uniform(0.4, 1.3)
    boards = bottom + np.concatenate([[0], np.cumsum(rng.uniform(0.18, 0.4, rng.integers(1, 4)))])
    top, thin = float(boards[-1]), rng.uniform(0.003, 0.012)
    solids = [box((-w, w), (-top, -bottom), (d - 0.01, d), "cabinet")]
    walls = np.linspace(-w, w, int(rng.integers(2, 4)))
    solids += [
        box((float(x) - thin, float(x) + thin), (-top, -bottom), (-d, d), "furniture")
        for x in walls
    ]
    solids += [
        box((-w, w), (-float(y) - thin, thin - float(y)), (-0.98 * d, d), "furniture")
        for y in boards
    ]
    for (level, above), (left, right) in itertools.product(
        itertools.pairwise(boards), itertools.pairwise(walls)
    ):
        middle, half = (left + right) / 2, (right - left) / 2 - 0.02
        room = float(above - level) - 0.03
        things = (
            _row_of_books(rng, half, d, room)
            if rng.random() < 0.25
            else _things(rng, int(rng.integers(1, 7)), half, d, 0.0, highest=room)
        )
        shift = np.array([middle, -level - thin, 0.0])
        solids += [thing._replace(centre=thing.centre + shift) for thing in things]
    return solids


def floor_things(rng: np.random.Generator) -> list[Solid]:
    """What lies about on a floor: boxes, shoes, cables, the legs of chairs."""
    solids = _things(rng, int(rng.integers(2, 9)), 0.7, 0.7, 0.0)
    for _ in range(rng.integers(1, 4)):
        solids += _cable(rng, rng.uniform((-0.6, -0.006, -0.6), (0.6, -0.003, 0.6)))
    for _ in range(rng.integers(0, 3)):
        x, z = rng.uniform(-0.6, 0.6, 2)
        for leg in range(5):  # an office chair's star
            turn = rotation(yaw=leg * 2 * np.pi / 5 + x)
            centre = np.array([x, -0.06, z]) + 0.15 * turn[:, 2]
            solids.append(Solid(BOX, centre, np.array([0.02, 0.015, 0.15]), turn, "metal"))
        solids.append(cylinder(x, z, 0.025, (-0.42, -0.06), "metal"))
        solids.append(box((x - 0.23, x + 0.23), (-0.48, -0.42), (z - 0.23, z + 0.23), "cloth"))
    return solids


def _screen(rng: np.random.Generator, x: float, z: float, y: float) -> list[Solid]:
    """A monitor on a foot, dark or showing something."""
    w, h = rng.uniform((0.15, 0.1), (0.32, 0.2))
    lift, thick = rng.uniform(0.05, 0.16), rng.uniform(0.01, 0.04)
    turn = rotation(yaw=rng.uniform(-0.5, 0.5), pitch=rng.uniform(-0.15, 0.1))
    middle = np.array([x, y - lift - h, z])
    rim = np.array([w + 0.012, h + 0.012, thick])
    shows = "screen" if rng.random() < 0.6 else "picture"
    front = middle - turn[:, 2] * (thick + 0.003)
    return [
        Solid(BOX, middle, rim, turn, "metal"),
        Solid(BOX, front, np.array([w, h, 0.003]), turn, shows),
        cylinder(x, z + 0.02, 0.02, (y - lift - h, y), "metal"),
        cylinder(x, z, rng.uniform(0.07, 0.12), (y - 0.012, y), "metal"),
    ]


def _keyboard(rng: np.random.Generator, x: float, z: float, y: float) -> list[Solid]:
    turn = rotation(yaw=rng.uniform(-0.3, 0.3))
    half = rng.uniform((0.14, 0.006, 0.05), (0.23, 0.014, 0.08))
    keys = Solid(BOX, np.array([x, y - half[1], z]), half, turn, "picture")
    place = keys.centre + turn[:, 0] * (half[0] + rng.uniform(0.06, 0.12))
    mouse = Solid(ELLIPSOID, place, np.array([0.03, 0.02, 0.055]), turn, "metal")
    return [keys, mouse]


def _things(
    rng: np.random.Generator, count: int, w: float, d: float, y: float, *, highest: float = 0.35
) -> list[Solid]:
    """Mugs, bottles, boxes, papers, books and toys on a surface at height ``y`` of +-w, +-d."""
    solids = []
    makers = (_mug, _bottle, _packet, _packet, _papers, _pile, _ball, _pen)
    for _ in range(count):
        x, z = rng.uniform((-w, -d), (w, d)) * 0.9
        for thing in makers[rng.integers(len(makers))](rng):
            if -(thing.centre[1] - thing.half_size.max()) < highest or thing.half_size[1] < 0.02:
                solids.append(thing._replace(centre=thing.centre + np.array([x, y, z])))
    return solids


def _mug(rng: np.random.Generator) -> list[Solid]:
    radius, h = rng.uniform((0.03, 0.07), (0.05, 0.13))
    yaw = rng.uniform(-np.pi, np.pi)
    place = np.array([np.sin(yaw) * radius * 1.3, -h / 2, np.cos(yaw) * radius * 1.3])
    grip = Solid(BOX, place, np.array([0.006, 0.3 * h, 0.02]), rotation(yaw=yaw), "clutter")
    return [cylinder(0.0, 0.0, radius, (-h, 0.0), "clutter"), grip]


def _bottle(rng: np.random.Generator) -> list[Solid]:
    radius, h = rng.uniform((0.02, 0.1), (0.045, 0.24))
    neck = rng.uniform(0.25, 0.6) * radius
    material = "panel" if rng.random() < 0.3 else "clutter"
    return [
        cylinder(0.0, 0.0, radius, (-h, 0.0), material),
        cylinder(0.0, 0.0, neck, (-h - rng.uniform(0.02, 0.08), -h), material),
    ]


def _packet(rng: np.random.Generator) -> list[Solid]:
    half = np.exp(rng.uniform(np.log(0.012), np.log(0.12), 3))
    turn = rotation(yaw=rng.uniform(-np.pi, np.pi))
    material = str(rng.choice(("clutter", "picture", "picture", "cabinet")))
    return [Solid(BOX, np.array([0.0, -half[1], 0.0]), half, turn, material)]


def _papers(rng: np.random.Generator) -> list[Solid]:
    half = rng.uniform((0.07, 0.0005, 0.1), (0.15, 0.004, 0.21))
    turn = rotation(yaw=rng.uniform(-np.pi, np.pi))
    return [Solid(BOX, np.array([0.0, -half[1], 0.0]), half, turn, "picture")]


def _pile(rng: np.random.Generator) -> list[Solid]:
    """Books lying on each other."""
    solids, top = [], 0.0
    for _ in range(rng.integers(1, 5)):
        half = rng.uniform((0.07, 0.006, 0.1), (0.12, 0.025, 0.16))
        turn = rotation(yaw=rng.uniform(-0.6, 0.6))
        solids.append(Solid(BOX, np.array([0.0, top - half[1], 0.0]), half, turn, "picture"))
        top -= 2 * half[1]
    return solids


def _ball(rng: np.random.Generator) -> list[Solid]:
    half = rng.uniform(0.02, 0.07, 3)
    return [Solid(ELLIPSOID, np.array([0.0, -half[1], 0.0]), half, np.eye(3), "clutter")]


def _pen(rng: np.random.Generator) -> list[Solid]:
    turn = rotation(yaw=rng.uniform(-np.pi, np.pi), pitch=np.pi / 2)
    half = np.array([0.005, rng.uniform(0.05, 0.09), 0.005])
    return [Solid(CYLINDER, np.array([0.0, -0.006, 0.0]), half, turn, "clutter")]


def _row_of_books(rng: np.random.Generator, w: float, d: float, highest: float) -> list[Solid]:
    """Books that stand side by side, each a little farther in or out."""
    solids, x = [], -w
    while (wide := rng.uniform(0.008, 0.03)) and x + 2 * wide < w:
        h, deep = rng.uniform((0.6, 0.5), (0.98, 0.9)) * (highest, d)
        front = rng.uniform(-0.9, -0.6) * d
        solids.append(box((x, x + 1.9 * wide), (-h, 0.0), (front, front + 1.5 * deep), "picture"))
        x += 2 * wide
    return solids


def _cable(rng: np.random.Generator, start: Array) -> list[Solid]:
    """Short thin cylinders end to end, level."""
    solids, yaw, radius = [], rng.uniform(-np.pi, np.pi), rng.uniform(0.002, 0.005)
    for _ in range(rng.integers(4, 12)):
        yaw += rng.normal(scale=0.5)
        half = rng.uniform(0.02, 0.06)
        turn = rotation(yaw=yaw, pitch=np.pi / 2)
        along = turn[:, 1] * half
        size = np.array([radius, half, radius])
        solids.append(Solid(CYLINDER, start + along, size, turn, "metal"))
        start = start + 2 * along
    return solids
