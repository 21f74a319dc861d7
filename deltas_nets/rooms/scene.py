"""A furnished box room, drawn from a seed: what there is, and how it looks.

World axes: x right, y down, z forward; the floor is y = 0 and the origin is the middle
of the floor. Solid 0 is the room itself, seen from inside.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from deltas_geom.cameras.views import PosedViews
from deltas_nets.rooms import furniture
from deltas_nets.rooms.furniture import BOX, Solid, rotation
from deltas_nets.rooms.materials import Surfaces, draw_surfaces
from deltas_nets.rooms.rig import draw_rig

Array = NDArray[np.float64]

CAMERA_CLEARANCE = 0.35  # m, nothing is nearer to a camera


class Solids(NamedTuple):
    """The shapes of a room, N of them."""

    shape: Tensor
    """``(N,)`` int64: BOX, ELLIPSOID or CYLINDER."""
    centre: Tensor
    """``(N, 3)`` world metres."""
    half_size: Tensor
    """``(N, 3)`` metres along the solid's own axes."""
    local_from_world: Tensor
    """``(N, 3, 3)`` rotations into the solid's own axes."""


class Light(NamedTuple):
    """A lamp, and light from everywhere."""

    position: Tensor
    """``(3,)`` world metres."""
    lamp: Tensor
    """``(3,)`` RGB."""
    ambient: Tensor
    """``(3,)`` RGB."""


class Room(NamedTuple):
    """All that a picture of a room depends on, except the camera."""

    solids: Solids
    surfaces: Surfaces
    light: Light
    brightness: float
    """Mean that the exposure aims at."""
    blur: float
    """Standard deviation of the lens in pixels."""


FREE_STANDING: tuple[Callable[[np.random.Generator], list[Solid]], ...] = (
    furniture.table,
    furniture.table,
    furniture.chair,
    furniture.chair,
    furniture.lamp,
    furniture.hanging_lamp,
    furniture.plant,
    furniture.plant,
    furniture.rack,
    furniture.column,
    furniture.cabinet,
    furniture.sofa,
)
AT_WALL: tuple[Callable[[np.random.Generator], list[Solid]], ...] = (
    furniture.shelf,
    furniture.shelf,
    furniture.cabinet,
    furniture.sofa,
    furniture.table,
    furniture.door,
    furniture.kitchen,
    furniture.kitchen,
)


def draw_room(
    seed: int, *, num_views: int, image_size: tuple[int, int], kinds: Mapping[str, tuple[int, ...]]
) -> tuple[Room, PosedViews]:
    """Draw a room and a rig of cameras in it.

    Args:
        seed: not negative.
        num_views: V.
        image_size: height, width.
        kinds: textures by what they show, as in ``Atlas.kinds``.

    Returns:
        The room, and V views: K ``(V, 3, 3)``, cam_from_world ``(V, 4, 4)``.
    """
    rng = np.random.default_rng(seed)
    half_size = _draw_room_size(rng)
    views = draw_rig(rng, room_half_size=half_size, num_views=num_views, image_size=image_size)
    world_from_cam = views.cam_from_world.double().inverse().numpy()
    middle = np.array([0.0, -half_size[1], 0.0])
    walls = Solid(BOX, middle, half_size, np.eye(3), "plain wall")
    groups = furnish(rng, half_size, world_from_cam[0])
    centres = world_from_cam[:, :3, 3]
    solids = [walls, *clear_of(groups, centres, CAMERA_CLEARANCE)]
    return light_and_paint(rng, solids, kinds), views


def light_and_paint(
    rng: np.random.Generator, solids: list[Solid], kinds: Mapping[str, tuple[int, ...]]
) -> Room:
    """Give a lamp, surfaces and an exposure to solids, the first of which are the walls."""
    middle, half_size = solids[0].centre, solids[0].half_size
    colour = rng.uniform(0.85, 1.15, 3)
    position = middle + rng.uniform(-0.8, 0.8, 3) * half_size
    position[1] = min(-1.6, 0.2 - 2 * half_size[1] + rng.uniform(0, 0.7))
    light = Light(
        position=torch.from_numpy(position).float(),
        lamp=torch.from_numpy(rng.uniform(0.3, 1.0) * colour).float(),
        ambient=torch.from_numpy(rng.uniform(0.3, 0.7) * colour).float(),
    )
    surfaces = draw_surfaces(rng, solids, kinds)
    brightness, blur = rng.uniform(0.32, 0.53), rng.uniform(0.2, 0.55)
    return Room(_stack(solids), surfaces, light, brightness, blur)


def _draw_room_size(rng: np.random.Generator) -> Array:
    """Half sizes in metres: as many halls and corridors as ordinary rooms.

    Halls are long, or depths beyond 5 m would be rare: things stand in the way.
    """
    if rng.random() < 0.5:
        across, along = rng.uniform(2.5, 5.0, 2)
    else:
        across, along = rng.uniform((2.4, 6.0), (7.5, 11.0))
    width, depth = (across, along) if rng.random() < 0.5 else (along, across)
    return np.array([width, rng.uniform(2.3, 3.4), depth]) / 2


def furnish(rng: np.random.Generator, half_size: Array, world_from_cam: Array) -> list[list[Solid]]:
    """Groups of solids in world axes, most of them where the anchor looks."""
    centre, forward = world_from_cam[:3, 3], world_from_cam[:3, 2]
    heading = np.arctan2(forward[0], forward[2])
    groups = []

    def place(group: list[Solid], origin: Array, turn: Array) -> None:
        groups.append(placed(group, origin, turn))

    for _ in range(rng.integers(3, 7)):
        spot, distance, _ = _look(centre, heading + rng.uniform(-0.65, 0.65), half_size)
        # Near things cover more of an image: log-uniform keeps the near ones rare enough.
        share = np.exp(rng.uniform(np.log(min(0.8, 1.0 / distance)), np.log(0.9)))
        turn = rotation(yaw=rng.uniform(-np.pi, np.pi))
        origin = (centre + share * (spot - centre)) * (1, 0, 1)
        place(FREE_STANDING[rng.integers(len(FREE_STANDING))](rng), origin, turn)
    ahead = [AT_WALL[rng.integers(len(AT_WALL))] for _ in range(rng.integers(1, 4))]
    ahead += [furniture.poster] * int(rng.integers(1, 5))
    # What is behind the cameras is seen in mirrors only.
    behind = [furniture.poster] * int(rng.integers(1, 5))
    for make, reach in [(make, 0.7) for make in ahead] + [(make, np.pi) for make in behind]:
        spot, _, wall_yaw = _look(centre, heading + rng.uniform(-reach, reach), half_size)
        group = make(rng)
        back = max(float(solid.centre[2] + solid.half_size[2]) for solid in group)
        turn = rotation(yaw=wall_yaw)
        place(group, spot * (1, 0, 1) - back * turn[:, 2], turn)
    for _ in range(rng.integers(0, 6)):
        pitch = np.arcsin(np.clip(-forward[1], -1, 1)) + rng.uniform(-0.35, 0.35)
        spot, distance, _ = _look(centre, heading + rng.uniform(-0.6, 0.6), half_size)
        share = np.exp(rng.uniform(np.log(min(0.8, 0.7 / distance)), np.log(0.9)))
        origin = centre + share * (spot - centre)
        origin[1] = np.clip(centre[1] - share * distance * np.tan(pitch), -2 * half_size[1], 0)
        place(furniture.floating(rng), origin, np.eye(3))
    return groups


def _look(centre: Array, yaw: float, half_size: Array) -> tuple[Array, float, float]:
    """Where a level ray meets a wall: the point ``(3,)``, metres to it, yaw into the wall."""
    direction = np.array([np.sin(yaw), 0.0, np.cos(yaw)])
    with np.errstate(divide="ignore"):
        reach = np.where(
            direction == 0, np.inf, (np.sign(direction) * half_size - centre) / direction
        )
    reach[1] = np.inf
    axis = int(reach.argmin())
    into_wall = np.sign(direction) * (np.arange(3) == axis)
    wall_yaw = float(np.arctan2(into_wall[0], into_wall[2]))
    return centre + reach[axis] * direction, float(reach[axis]), wall_yaw


def placed(group: list[Solid], origin: Array, turn: Array) -> list[Solid]:
    """A group of furniture in world axes."""
    return [s._replace(centre=turn @ s.centre + origin, rotation=turn @ s.rotation) for s in group]


def clear_of(groups: list[list[Solid]], cameras: Array, clearance: float) -> list[Solid]:
    """The solids of the groups that come nowhere near the cameras ``(V, 3)``.

    Args:
        clearance: metres, of the bounding box of every solid of a group.
    """
    return [solid for group in groups if _is_clear(group, cameras, clearance) for solid in group]


def _is_clear(group: list[Solid], cameras: Array, clearance: float) -> bool:
    for solid in group:
        local = np.abs((cameras - solid.centre) @ solid.rotation)
        distance = np.linalg.norm(np.maximum(local - solid.half_size, 0), axis=-1)
        if distance.min() < clearance:
            return False
    return True


def _stack(solids: list[Solid]) -> Solids:
    return Solids(
        shape=torch.tensor([solid.shape for solid in solids]),
        centre=torch.from_numpy(np.stack([solid.centre for solid in solids])).float(),
        half_size=torch.from_numpy(np.stack([solid.half_size for solid in solids])).float(),
        local_from_world=torch.from_numpy(np.stack([solid.rotation.T for solid in solids])).float(),
    )
