"""Desks, shelves and floors from near by, in a room: what an arm's length away looks like."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from deltas_geom.cameras.views import PosedViews
from deltas_nets.rooms import close_things
from deltas_nets.rooms.furniture import BOX, Solid, rotation
from deltas_nets.rooms.materials import Surfaces
from deltas_nets.rooms.rig import draw_close_rig
from deltas_nets.rooms.scene import Room, clear_of, furnish, light_and_paint, placed

Array = NDArray[np.float64]

CLEARANCE = 0.15  # m, nothing is nearer to a camera
SUBJECTS = (close_things.desk, close_things.desk, close_things.bins, close_things.floor_things)
DISTANCES = (0.4, 1.8)  # m, to what the cameras look at
TO_CAMERA = 0.4  # m, from walls, floor and ceiling
TRIES = 20
TO_WALL = 0.05  # m, from the back of a desk or a shelf


def draw_close_up(
    seed: int, *, num_views: int, image_size: tuple[int, int], kinds: Mapping[str, tuple[int, ...]]
) -> tuple[Room, PosedViews]:
    """Draw a desk, a shelf or a floor, the room around it, and a rig of cameras close to it.

    Args:
        seed: not negative.
        num_views: V.
        image_size: height, width.
        kinds: textures by what they show, as in ``Atlas.kinds``.

    Returns:
        The room, and V views: K ``(V, 3, 3)``, cam_from_world ``(V, 4, 4)``.
    """
    rng = np.random.default_rng([seed, 1])
    half_size = np.array([*rng.uniform((2.0, 2.3), (5.0, 3.2)), rng.uniform(2.0, 5.0)]) / 2
    walls = Solid(BOX, np.array([0.0, -half_size[1], 0.0]), half_size, np.eye(3), "plain wall")
    make = SUBJECTS[rng.integers(len(SUBJECTS))]
    subject = make(rng)
    # Against the wall ahead, or free with the room behind it.
    back = max(float(solid.centre[2] + solid.half_size[2]) for solid in subject)
    near_wall = half_size[2] - back - TO_WALL
    z = near_wall if rng.random() < 0.6 else rng.uniform(-0.2, 0.7) * near_wall
    origin = np.array([rng.uniform(-0.3, 0.3) * half_size[0], 0.0, z])
    subject = placed(subject, origin, np.eye(3))
    views = _look_at(rng, subject, make is close_things.bins, half_size, num_views, image_size)
    world_from_cam = views.cam_from_world.double().inverse().numpy()
    centres = world_from_cam[:, :3, 3]
    around = furnish(rng, half_size, world_from_cam[0])
    # One thing in the way of a camera is left out, not the whole desk.
    things = [[solid] for solid in subject]
    solids = [walls, *clear_of(things, centres, CLEARANCE), *clear_of(around, centres, 0.4)]
    room = light_and_paint(rng, solids, kinds)
    if rng.random() < 0.5:
        room = room._replace(surfaces=_plain_floor(rng, room.surfaces))
    return room, views


def _look_at(
    rng: np.random.Generator,
    subject: list[Solid],
    upright: bool,
    half_size: Array,
    num_views: int,
    image_size: tuple[int, int],
) -> PosedViews:
    """A rig that looks at one of the subject's solids; ``upright`` ones from in front."""
    target = subject[rng.integers(len(subject))].centre + rng.normal(scale=0.05, size=3)
    down = (-0.25, 0.5) if upright else (0.15, 1.2)
    middle = np.array([0.0, -half_size[1], 0.0])
    free = half_size - TO_CAMERA
    centre = middle
    for _ in range(TRIES):
        distance = np.exp(rng.uniform(*np.log(DISTANCES)))
        looks = rotation(yaw=rng.uniform(-0.8, 0.8), pitch=-rng.uniform(*down))[:, 2]
        tried = np.clip(target - distance * looks, middle - free, middle + free)
        if np.linalg.norm(target - tried) > DISTANCES[0]:
            centre = tried
            break
    return draw_close_rig(
        rng,
        target=target,
        centre=centre,
        room_half_size=half_size,
        num_views=num_views,
        image_size=image_size,
    )


def _plain_floor(rng: np.random.Generator, surfaces: Surfaces) -> Surfaces:
    """The same with a floor of next to no texture, often dark: carpets, linoleum, concrete."""
    floor = (0, 3)
    contrast, tint, gloss = surfaces.contrast.clone(), surfaces.tint.clone(), surfaces.gloss.clone()
    contrast[floor] = float(np.exp(rng.uniform(np.log(0.01), np.log(0.15))))
    tint[floor] *= float(np.exp(rng.uniform(np.log(0.1), np.log(1.2)))) / tint[floor].mean()
    if rng.random() < 0.7:
        gloss[floor] = 0.0
    return surfaces._replace(contrast=contrast, tint=tint, gloss=gloss)
