"""Cameras of a room: views a hand-held or head-worn camera, or a stereo pair, would have."""

import numpy as np
import torch
from numpy.typing import NDArray

from deltas_geom.cameras.views import PosedViews
from deltas_nets.rooms.furniture import rotation

Array = NDArray[np.float64]

FOCAL_RANGE = (0.75, 1.45)  # of the image width
BASELINE_RANGE = (0.03, 0.6)  # m, between any two views of one rig
WALL_MARGIN = 0.4  # m, no camera comes nearer to a wall, the floor or the ceiling
CLOSE_MARGIN = 0.12  # m, the same where cameras are close to things
MAX_PITCH = 0.7  # rad
MAX_VIEWS = 12
USUAL_DISTANCE = 1.5  # m, from which baselines are those of a room
# How much a camera moves in x, y and z of its own axes: sideways most.
MOTION_SHAPE = np.array([1.0, 0.6, 0.7])


def draw_rig(
    rng: np.random.Generator,
    *,
    room_half_size: Array,
    num_views: int,
    image_size: tuple[int, int],
) -> PosedViews:
    """Cameras that share intrinsics and look at about the same part of a room.

    Args:
        rng: all randomness comes from here.
        room_half_size: ``(3,)`` metres; the floor is at y = 0, the ceiling at -2 half sizes.
        num_views: V, 1 to ``MAX_VIEWS``.
        image_size: height, width.

    Returns:
        float32 views, K ``(V, 3, 3)`` and cam_from_world ``(V, 4, 4)``.

    Raises:
        ValueError: there is no room for so many views.
    """
    anchor, turn = _draw_anchor(rng, room_half_size)
    offsets = _draw_offsets(rng, num_views)
    centres = _inside(anchor + offsets @ turn.T, room_half_size, WALL_MARGIN)

    # The point that the views turn towards is 1 to 3.5 m away.
    return _views(rng, centres, offsets, turn, rng.uniform(1.0, 3.5), image_size)


def draw_close_rig(
    rng: np.random.Generator,
    *,
    target: Array,
    centre: Array,
    room_half_size: Array,
    num_views: int,
    image_size: tuple[int, int],
) -> PosedViews:
    """Cameras around one that looks at a point from near by, closer together the nearer they are.

    Args:
        rng: all randomness comes from here.
        target: ``(3,)`` world metres, about where the anchor looks.
        centre: ``(3,)`` world metres, about where it is.
        room_half_size: ``(3,)`` metres, as for :func:`draw_rig`.
        num_views: V, 1 to ``MAX_VIEWS``.
        image_size: height, width.

    Returns:
        float32 views, K ``(V, 3, 3)`` and cam_from_world ``(V, 4, 4)``.

    Raises:
        ValueError: there is no room for so many views.
    """
    x, y, z = target - centre
    distance = float(np.linalg.norm((x, y, z)))
    yaw, pitch = float(np.arctan2(x, z)), float(-np.arcsin(y / distance))
    looks = rotation(yaw=yaw, pitch=pitch, roll=rng.normal(scale=0.1))
    offsets = _draw_offsets(rng, num_views) * min(1.0, distance / USUAL_DISTANCE)
    centres = _inside(centre + offsets @ looks.T, room_half_size, CLOSE_MARGIN)
    aside = rotation(yaw=rng.normal(scale=0.1), pitch=rng.normal(scale=0.08))
    return _views(rng, centres, offsets, looks @ aside, distance, image_size)


def _views(
    rng: np.random.Generator,
    centres: Array,
    offsets: Array,
    turn: Array,
    distance: float,
    image_size: tuple[int, int],
) -> PosedViews:
    """Views at ``centres``, which are ``offsets`` from the anchor in its own axes."""
    num_views = len(centres)
    cam_from_world = np.tile(np.eye(4), (num_views, 1, 1))
    for view, offset in enumerate(offsets):
        world_from_cam = turn if view == 0 else turn @ _source_turn(rng, offset, distance)
        cam_from_world[view, :3, :3] = world_from_cam.T
        cam_from_world[view, :3, 3] = -world_from_cam.T @ centres[view]
    K = np.tile(_draw_intrinsics(rng, image_size), (num_views, 1, 1))
    return PosedViews(torch.from_numpy(K).float(), torch.from_numpy(cam_from_world).float())


def _draw_intrinsics(rng: np.random.Generator, image_size: tuple[int, int]) -> Array:
    height, width = image_size
    focal = width * np.exp(rng.uniform(*np.log(FOCAL_RANGE)))
    aspect = rng.uniform(0.98, 1.02)  # sensors that were resized to another shape
    x = (width - 1) / 2 + width * rng.uniform(-0.03, 0.03)
    y = (height - 1) / 2 + height * rng.uniform(-0.03, 0.03)
    return np.array([[focal, 0, x], [0, focal * aspect, y], [0, 0, 1]])


def _draw_anchor(rng: np.random.Generator, room_half_size: Array) -> tuple[Array, Array]:
    """Centre ``(3,)`` and world_from_cam rotation ``(3, 3)`` of view 0."""
    low, high = _free_space(room_half_size, WALL_MARGIN)
    centre = rng.uniform(low, high)
    # Standing or sitting people: the head is 0.8 to 1.9 m above the floor.
    centre[1] = np.clip(-rng.uniform(0.8, 1.9), low[1], high[1])
    # A camera near a wall looks away from it: at the far half of the room.
    target = rng.uniform(-0.9, 0.9, 3) * room_half_size
    target[1] = -rng.uniform(0.1, 2.1)
    across = target - centre
    if np.hypot(across[0], across[2]) < 1.2:
        across = -centre * (1, 0, 1) + rng.uniform(-1e-3, 1e-3, 3)
    yaw = np.arctan2(across[0], across[2]) + rng.uniform(-0.3, 0.3)
    pitch = np.arctan2(-across[1], np.hypot(across[0], across[2])) + rng.uniform(-0.15, 0.15)
    # Mostly upright, now and then a head or a hand that leans.
    roll = rng.normal(scale=0.05) if rng.random() < 0.8 else rng.uniform(-0.4, 0.4)
    turn = rotation(yaw=yaw, pitch=np.clip(pitch, -MAX_PITCH, MAX_PITCH), roll=roll)
    return centre, turn


def _draw_offsets(rng: np.random.Generator, num_views: int) -> Array:
    """Camera centres ``(V, 3)`` in metres in the axes of view 0, which is at the origin.

    A third of the rigs are in line, evenly spaced like a tracking shot or a stereo rig;
    the others are scattered.
    """
    if not 1 <= num_views <= MAX_VIEWS:
        raise ValueError(f"num_views must be 1 to {MAX_VIEWS}, got {num_views}")
    if rng.random() < 0.35:
        # With many views the whole line may be longer than one good baseline.
        step = rng.uniform(0.05, min(0.3, 0.75 / max(num_views - 1, 1)))
        direction = _direction(rng)
        order = np.arange(num_views) - rng.integers(num_views)
        places = np.concatenate([[0], rng.permutation(order[order != 0])])
        sway = rng.normal(scale=0.004, size=(num_views, 3)) * (places != 0)[:, None]
        line: Array = places[:, None] * step * direction + sway
        return line
    scale = rng.uniform(0.1, 0.36)  # m, small for slow hands, large for walking
    offsets = np.zeros((1, 3))
    while len(offsets) < num_views:
        candidate = _direction(rng) * scale * rng.uniform(0.3, 1.4)
        distances = np.linalg.norm(offsets - candidate, axis=1)
        if BASELINE_RANGE[0] < distances.min() and distances.max() < BASELINE_RANGE[1]:
            offsets = np.vstack([offsets, candidate])
        else:
            scale = min(1.02 * scale, 0.3)  # room for more views
    return offsets


def _direction(rng: np.random.Generator) -> Array:
    direction = rng.uniform(-1, 1, 3) * MOTION_SHAPE
    unit: Array = direction / np.linalg.norm(direction)
    return unit


def _source_turn(rng: np.random.Generator, offset: Array, distance: float) -> Array:
    """Anchor-from-source rotation that partly fixates a point ahead, with some jitter."""
    fixate = rng.uniform(-0.2, 1.0)
    x, y, z = offset
    loose = 1.0 if rng.random() < 0.75 else 3.5  # now and then the head turns
    yaw = -fixate * np.arctan2(x, distance - z) + rng.normal(scale=0.04 * loose)
    pitch = fixate * np.arctan2(y, distance - z) + rng.normal(scale=0.03 * loose)
    return rotation(yaw=yaw, pitch=pitch, roll=rng.normal(scale=0.035 * loose))


def _inside(centres: Array, room_half_size: Array, margin: float) -> Array:
    """Where a wall is in the way, the whole rig moves; its baselines stay."""
    low, high = _free_space(room_half_size, margin)
    moved: Array = (
        centres
        + np.maximum(low - centres.min(axis=0), 0)
        - np.maximum(centres.max(axis=0) - high, 0)
    )
    return moved


def _free_space(room_half_size: Array, margin: float) -> tuple[Array, Array]:
    """Lowest and highest camera centre, ``(3,)`` each."""
    half = room_half_size - margin
    middle = np.array([0, -room_half_size[1], 0])
    return middle - half, middle + half
