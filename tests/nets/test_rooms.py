"""Drawn rooms: shapes, reproducibility, and geometry that all views agree on."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional as F
from torch.testing import assert_close
from torch.utils.data import DataLoader, default_collate

from deltas_geom.cameras.projection import project, unproject
from deltas_geom.cameras.views import PosedViews
from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.rooms import Rooms, draw_room, render_close_up, render_room, texture_atlas
from deltas_nets.rooms.cast import cast_rays
from deltas_nets.rooms.enlarged import as_large_as_rooms
from deltas_nets.rooms.furniture import BOX, CYLINDER, ELLIPSOID
from deltas_nets.rooms.materials import Surfaces
from deltas_nets.rooms.render import _mirror_image, render_view
from deltas_nets.rooms.scene import Room, Solids
from deltas_nets.rooms.textures import (
    GROUNDS,
    LEVEL_SIZES,
    PICTURES,
    TEXELS_PER_TEXTURE,
    load_picture,
)

SIZE = (72, 96)
SEEDS = range(4)


@pytest.fixture(scope="module", params=[render_room, render_close_up])
def render(request: pytest.FixtureRequest) -> Callable[..., PosedImages]:
    return request.param


@pytest.fixture(scope="module")
def rooms(render: Callable[..., PosedImages]) -> list[PosedImages]:
    return [render(seed, num_views=3, image_size=SIZE) for seed in SEEDS]


# Shapes and values


def test_an_item_has_the_shapes_and_types_it_promises(rooms: list[PosedImages]) -> None:
    images, views, depth = rooms[0]
    assert images.shape == (3, 3, *SIZE) and images.dtype == torch.uint8
    assert views.K.shape == (3, 3, 3) and views.K.dtype == torch.float32
    assert views.cam_from_world.shape == (3, 4, 4) and views.cam_from_world.dtype == torch.float32
    assert depth.shape == (3, *SIZE) and depth.dtype == torch.float32


def test_every_pixel_has_a_depth_within_a_house(rooms: list[PosedImages]) -> None:
    depth = torch.stack([room.depth for room in rooms])
    assert depth.isfinite().all()
    assert depth.min() > 0.1 and depth.max() < 14  # m


def test_close_ups_are_closer_than_rooms() -> None:
    def median(render: Callable[..., PosedImages]) -> float:
        depths = [render(seed, num_views=1, image_size=SIZE).depth.median() for seed in range(12)]
        return float(torch.stack(depths).median())

    assert 0.3 < median(render_close_up) < 1.2 < median(render_room)  # m


def test_exposure_aims_at_a_mean_brightness(rooms: list[PosedImages]) -> None:
    for room in rooms:
        assert 0.3 <= room.images.float().mean() / 255 <= 0.55


def test_cameras_are_rigid_apart_and_of_the_promised_focal_length() -> None:
    for seed in range(40):
        _, views = draw_room(seed, num_views=5, image_size=SIZE, kinds=texture_atlas().kinds)
        rotation = views.cam_from_world[:, :3, :3]
        assert_close(rotation @ rotation.mT, torch.eye(3).expand(5, 3, 3), rtol=0, atol=1e-5)
        assert (torch.linalg.det(rotation) > 0).all()
        centres = (-rotation.mT @ views.cam_from_world[:, :3, 3:])[..., 0]
        baselines = F.pdist(centres)
        assert baselines.min() > 0.02 and baselines.max() < 0.9  # m
        focal = views.K[:, 0, 0] / SIZE[1]
        assert ((focal >= 0.75) & (focal <= 1.45)).all()


@pytest.mark.parametrize("num_views", [0, 13])
def test_a_rig_of_no_or_too_many_views_is_an_error(
    num_views: int, render: Callable[..., PosedImages]
) -> None:
    with pytest.raises(ValueError, match=f"num_views must be 1 to 12, got {num_views}"):
        render(0, num_views=num_views, image_size=SIZE)


# Reproducibility


def test_a_seed_gives_the_same_room_whatever_was_drawn_before(
    rooms: list[PosedImages], render: Callable[..., PosedImages]
) -> None:
    torch.manual_seed(1)
    np.random.seed(1)  # noqa: NPY002 - the global generator is what must not matter
    before = torch.get_rng_state()
    assert_same(render(2, num_views=3, image_size=SIZE), rooms[2])
    assert torch.equal(torch.get_rng_state(), before)


def test_different_seeds_give_different_rooms(rooms: list[PosedImages]) -> None:
    assert not torch.equal(rooms[0].images, rooms[1].images)
    assert not torch.equal(rooms[0].depth, rooms[1].depth)
    assert not torch.equal(rooms[0].views.K, rooms[1].views.K)


# Geometry


def test_views_agree_on_depth_and_colour_where_both_see(rooms: list[PosedImages]) -> None:
    seen, agreeing, differences = [], [], []
    for room in rooms:
        for source in (1, 2):
            ratio, difference, inside = compare(room, anchor=0, source=source)
            visible = inside & (ratio > 0.97)  # else something stands in front
            close = visible & ((ratio - 1).abs() < 0.01)
            seen.append(visible.float().mean())
            agreeing.append(close.sum() / visible.sum())
            differences.append(difference[close].mean())
    assert 0.4 < torch.stack(seen).mean() < 0.95
    assert torch.stack(agreeing).min() > 0.98
    assert torch.stack(agreeing).mean() > 0.99
    assert torch.stack(differences).mean() < 6  # grey levels


def test_the_agreement_is_no_accident(rooms: list[PosedImages]) -> None:
    room = rooms[0]
    # The anchor's only: shrinking all depths alike hardly shows at short baselines.
    wrong_depth = torch.cat([1.1 * room.depth[:1], room.depth[1:]])
    ratio, _, inside = compare(room._replace(depth=wrong_depth), anchor=0, source=1)
    true_ratio, _, true_inside = compare(room, anchor=0, source=1)
    wrong = ((ratio - 1).abs() < 0.01)[inside].float().mean()
    right = ((true_ratio - 1).abs() < 0.01)[true_inside].float().mean()
    assert wrong < right - 0.3


@pytest.mark.parametrize("seed", SEEDS)
def test_a_pixel_sees_the_first_surface_on_its_ray(seed: int) -> None:
    """An oracle without rectangles: walk along K^-1 (x, y, 1) in float64."""
    room, views = draw_room(seed, num_views=1, image_size=SIZE, kinds=texture_atlas().kinds)
    depth, solid = cast_rays(room.solids, views.K[0], views.cam_from_world[0], image_size=SIZE)
    y, x = torch.meshgrid(torch.arange(0, SIZE[0], 3), torch.arange(0, SIZE[1], 3), indexing="ij")
    pixels = torch.stack([x, y, torch.ones_like(x)]).double().flatten(1)
    rays = torch.linalg.inv(views.K[0].double()) @ pixels
    z = depth.double()[y, x].flatten()
    world_from_cam = torch.linalg.inv(views.cam_from_world[0].double())

    def inside(depths: Tensor) -> Tensor:
        """How far out ``(N, P)`` the points at these depths are; 1 is the surface."""
        points = world_from_cam[:3, :3] @ (rays * depths) + world_from_cam[:3, 3:]
        return extent(room.solids, points)

    hit = inside(z).gather(0, solid[y, x].flatten()[None])[0]
    smallest = room.solids.half_size[solid[y, x].flatten()].amin(dim=1)
    assert ((hit - 1).abs() * smallest < 1e-4).all()  # m
    for share in torch.linspace(0.02, 0.999, 60).tolist():
        before = inside(share * z)
        assert (before[0] < 1 + 1e-4).all()
        # Grazing rays and hair-thin solids aside, nothing has been passed over.
        assert (before[1:] < 1 - 1e-3).sum() == 0


def test_the_view_from_inside_along_the_axis_of_a_cylinder_is_finite() -> None:
    solids = Solids(
        shape=torch.tensor([BOX, CYLINDER, ELLIPSOID]),
        centre=torch.tensor([[0.0, 0, 0], [0, 2, 0], [0, -2, 0]]),
        half_size=torch.tensor([[5.0, 5, 5], [0.5, 1, 0.5], [0.3, 0.3, 0.3]]),
        local_from_world=torch.eye(3).expand(3, 3, 3),
    )
    K = torch.tensor([[10.0, 0, 4], [0, 10, 4], [0, 0, 1]])
    down = torch.eye(4)
    down[:3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # camera z is world y
    depth, solid = cast_rays(solids, K, down, image_size=(9, 9))
    assert depth.isfinite().all()
    assert solid[4, 4] == 1 and depth[4, 4] == 1.0  # the cap
    assert solid[0, 0] == 0 and depth[0, 0] == 5.0  # the floor


# Mirrors


def polished(seed: int, *, gloss: float) -> tuple[Room, PosedViews]:
    """A room whose floor mirrors; nothing else does, and the lens is sharp."""
    room, views = draw_room(seed, num_views=1, image_size=SIZE, kinds=texture_atlas().kinds)
    shares = torch.zeros_like(room.surfaces.gloss)
    shares[0, 3] = gloss
    smooth = torch.full_like(room.surfaces.roughness, 1e-4)
    surfaces = room.surfaces._replace(gloss=shares, roughness=smooth)
    return room._replace(surfaces=surfaces, blur=0.01), views


@cache
def floor_seed() -> int:
    """A seed whose camera sees much of the floor."""
    for seed in range(20):
        room, views = polished(seed, gloss=0.5)
        hits = cast_rays(room.solids, views.K[0], views.cam_from_world[0], image_size=SIZE)
        height = floor_height(hits.depth, views)
        if ((height.abs() < 1e-3) & (hits.solid == 0)).float().mean() > 0.2:
            return seed
    raise AssertionError("no room shows its floor")


def floor_height(depth: Tensor, views: PosedViews) -> Tensor:
    """World y of what each pixel sees."""
    return world_points(depth, views)[1].view(SIZE)


def world_points(depth: Tensor, views: PosedViews) -> Tensor:
    y, x = torch.meshgrid(torch.arange(SIZE[0]), torch.arange(SIZE[1]), indexing="ij")
    pixels = torch.stack([x, y], dim=-1).flatten(0, 1).float()
    return unproject(views, pixels[None], depth.flatten()[None])[0].T


def test_a_mirror_keeps_its_own_depth() -> None:
    atlas = texture_atlas()
    for seed in SEEDS:
        room, views = draw_room(seed, num_views=1, image_size=SIZE, kinds=atlas.kinds)
        matte = room.surfaces._replace(gloss=torch.zeros_like(room.surfaces.gloss))
        camera = views.K[0], views.cam_from_world[0]
        _, depth = render_view(room, atlas, *camera, image_size=SIZE)
        _, expected = render_view(room._replace(surfaces=matte), atlas, *camera, image_size=SIZE)
        assert torch.equal(depth, expected)


def test_a_polished_floor_shows_what_stands_at_the_end_of_the_reflected_ray() -> None:
    """An oracle: walk along each reflected ray and ask whether it is inside a solid."""
    room, views = polished(floor_seed(), gloss=0.5)
    K, cam_from_world = views.K[0], views.cam_from_world[0]
    hits = cast_rays(room.solids, K, cam_from_world, image_size=SIZE)
    mirrored = cam_from_world @ _mirror_image(room, 3)
    seen = cast_rays(room.solids, K, mirrored, image_size=SIZE, beyond=hits.depth + 1e-3)
    points = world_points(hits.depth, views).double()
    on_floor = (points[1].abs() < 1e-3) & (hits.solid.flatten() == 0)
    centre = -cam_from_world[:3, :3].mT.double() @ cam_from_world[:3, 3:].double()
    onward = (points - centre) * torch.tensor([[1.0], [-1], [1]])  # off the floor y = 0
    # The ray's parameter goes on from the mirror: at twice its depth, as far again.
    ratio = (seen.depth / hits.depth).flatten().double() - 1
    met = points + ratio * onward
    reached = extent(room.solids, met).gather(0, seen.solid.flatten()[None])[0]
    smallest = room.solids.half_size[seen.solid.flatten()].amin(dim=1)
    assert ((reached - 1).abs() * smallest)[on_floor].max() < 1e-3  # m
    for share in torch.linspace(0.02, 0.995, 40).tolist():
        before = extent(room.solids, points + share * ratio * onward)[1:, on_floor]
        assert (before < 1 - 1e-2).sum() == 0


def test_a_polished_floor_is_the_matte_floor_and_a_share_of_the_mirrored_light() -> None:
    atlas = texture_atlas()
    seed = floor_seed()
    images = []
    for gloss in (0.0, 0.2, 0.4):
        room, views = polished(seed, gloss=gloss)
        dark = room._replace(light=room.light._replace(lamp=torch.zeros(3)))  # no highlight
        image, depth = render_view(dark, atlas, *(t[0] for t in views), image_size=SIZE)
        images.append(image)
    matte, little, much = images
    floor = floor_height(depth, views).abs() < 1e-3
    assert torch.equal(matte[:, ~floor], much[:, ~floor])
    gained = (little - matte)[:, floor]
    assert (gained > 0).float().mean() > 0.9
    # Schlick: the share is linear in the gloss, g + (1 - g) k.
    twice = (much - matte)[:, floor]
    assert (twice <= 2 * gained + 1e-5).all() and (twice >= gained - 1e-5).all()


@pytest.mark.parametrize("seed", SEEDS)
def test_a_mirror_image_leaves_the_mirror_where_it_is(seed: int) -> None:
    room, _ = draw_room(seed, num_views=1, image_size=SIZE, kinds=texture_atlas().kinds)
    for face in range(6 * len(room.solids.shape)):
        solid, axis, sign = face // 6, face % 6 // 2, face % 2 * 2 - 1
        places = torch.rand(5, 3, generator=torch.Generator().manual_seed(face)) * 2 - 1
        places[:, axis] = sign
        local = places * room.solids.half_size[solid]
        points = local @ room.solids.local_from_world[solid] + room.solids.centre[solid]
        image = _mirror_image(room, face)
        assert_close(points @ image[:3, :3].mT + image[:3, 3], points, rtol=0, atol=1e-4)
        assert_close(image @ image, torch.eye(4), rtol=0, atol=1e-4)
        assert torch.linalg.det(image[:3, :3]) < 0


def test_what_is_behind_a_mirror_is_not_mirrored() -> None:
    atlas = texture_atlas()
    room, views = polished(floor_seed(), gloss=0.5)
    shape, centre, half_size, local_from_world = room.solids
    cellar = Solids(
        torch.cat([shape, torch.tensor([BOX])]),
        torch.cat([centre, torch.tensor([[0.0, 1.0, 0.0]])]),  # y is down: under the floor
        torch.cat([half_size, torch.tensor([[9.0, 0.2, 9.0]])]),
        torch.cat([local_from_world, torch.eye(3)[None]]),
    )
    looks = Surfaces(*(torch.cat([part, part[-1:]]) for part in room.surfaces))
    camera = views.K[0], views.cam_from_world[0]
    expected, _ = render_view(room, atlas, *camera, image_size=SIZE)
    below = room._replace(solids=cellar, surfaces=looks)
    found, _ = render_view(below, atlas, *camera, image_size=SIZE)
    # Not to the bit: with another number of solids some processors round in another order.
    assert_close(found, expected, rtol=0, atol=1e-5)  # a step of colour is 400 times that


def test_reflections_do_not_stay_on_the_surface() -> None:
    """Read at the surface's true depth, a mirror's colours of two views disagree."""
    gloss = [compare_floor(floor_seed(), share) for share in (0.0, 0.6)]
    assert gloss[1] > 1.5 * gloss[0]


def compare_floor(seed: int, gloss: float) -> Tensor:
    """Mean difference of colour between two views of the floor's own points."""
    atlas = texture_atlas()
    room, views = polished(seed, gloss=gloss)
    aside = views.cam_from_world[0].clone()
    aside[0, 3] += 0.2
    first, depth = render_view(room, atlas, views.K[0], views.cam_from_world[0], image_size=SIZE)
    second, other = render_view(room, atlas, views.K[0], aside, image_size=SIZE)
    pair = PosedViews(views.K.expand(2, 3, 3), torch.stack([views.cam_from_world[0], aside]))
    item = PosedImages(
        (torch.stack([first, second]).clamp(0, 1) * 255).round().to(torch.uint8),
        pair,
        torch.stack([depth, other]),
    )
    ratio, difference, inside = compare(item, anchor=0, source=1)
    floor = (floor_height(depth, views).abs() < 1e-3).flatten()
    return difference[inside & floor & ((ratio - 1).abs() < 0.01)].mean()


# Textures


def test_textures_come_from_the_wheel_and_never_from_the_motorcycle() -> None:
    for name in (*PICTURES, *GROUNDS):
        assert "motorcycle" not in name
        assert load_picture(name).mode == "RGB"


def test_the_atlas_holds_every_level_of_every_texture() -> None:
    texels, kinds = texture_atlas()
    indices = sorted(index for members in kinds.values() for index in members)
    assert indices == list(range(len(indices)))
    assert texels.shape == (len(indices) * TEXELS_PER_TEXTURE, 3)
    assert texels.dtype == torch.uint8
    first = texels[: LEVEL_SIZES[0] ** 2].float().mean()
    last = texels[TEXELS_PER_TEXTURE - LEVEL_SIZES[-1] ** 2 : TEXELS_PER_TEXTURE].float().mean()
    assert_close(first, last, rtol=0, atol=0.5)


# The data set


def test_a_cached_room_is_the_rendered_room(tmp_path: Path) -> None:
    rooms = Rooms(2, seed=5, num_views=2, image_size=SIZE, cache_dir=tmp_path / "cache")
    first, again = rooms[1], rooms[1]
    assert_same(first, again)
    assert_same(first, render_room(6, num_views=2, image_size=SIZE))
    assert [path.suffix for path in (tmp_path / "cache").iterdir()] == [".safetensors"]
    other = Rooms(2, seed=5, num_views=3, image_size=SIZE, cache_dir=tmp_path / "cache")
    assert other[1].images.shape[0] == 3  # not the file of two views


def test_close_ups_are_some_of_the_rooms_and_as_large_as_the_others(tmp_path: Path) -> None:
    rooms = Rooms(
        30, seed=5, num_views=1, image_size=(24, 32), close_ups=0.5, cache_dir=tmp_path / "cache"
    )
    medians = [float(room.depth.median()) for room in rooms]
    names = [path.name.split("-v")[0] for path in (tmp_path / "cache").iterdir()]
    assert 8 <= names.count("close-up") <= 22 and names.count("room") == 30 - names.count(
        "close-up"
    )
    assert min(medians) >= 1.0 and max(medians) <= 10.0
    assert [float(room.depth.median()) for room in rooms] == medians  # read as they were rendered


def test_an_enlarged_scene_looks_the_same() -> None:
    desk = render_close_up(1, num_views=2, image_size=SIZE)  # median 0.8 m
    enlarged = as_large_as_rooms(desk, 7)
    larger = enlarged.depth.median() / desk.depth.median()
    assert larger > 1.5
    for before, after in zip(
        compare(desk, anchor=0, source=1), compare(enlarged, anchor=0, source=1), strict=True
    ):
        assert_close(before.float(), after.float(), rtol=0, atol=0.02)


def test_rooms_batch_like_any_data_set() -> None:
    rooms = Rooms(2, num_views=2, image_size=SIZE)
    assert len(rooms) == 2 and len(list(DataLoader(rooms, batch_size=None))) == 2
    batch = default_collate([rooms[0], rooms[1]])
    assert isinstance(batch, PosedImages) and isinstance(batch.views, PosedViews)
    assert batch.images.shape == (2, 2, 3, *SIZE)
    with pytest.raises(IndexError):
        rooms[2]


def assert_same(a: PosedImages, b: PosedImages) -> None:
    for left, right in zip(
        (a.images, *a.views, a.depth), (b.images, *b.views, b.depth), strict=True
    ):
        assert left.dtype == right.dtype and torch.equal(left, right)


def compare(room: PosedImages, *, anchor: int, source: int) -> tuple[Tensor, Tensor, Tensor]:
    """Look from the source at what the anchor sees.

    Returns:
        Per anchor pixel ``(P,)``: the source's depth there over the depth expected, the
        mean colour difference in grey levels, and whether it is in the image.
    """
    height, width = room.depth.shape[-2:]
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    pixels = torch.stack([x, y], dim=-1).float().view(1, -1, 2)
    only_anchor = PosedViews(*(part[anchor : anchor + 1] for part in room.views))
    points = unproject(only_anchor, pixels, room.depth[anchor].view(1, -1))[0]
    there = project(PosedViews(*(part[source : source + 1] for part in room.views)), points)
    place, expected = there.pixels[0], there.depth[0]
    limit = torch.tensor([width, height]) - 0.5
    inside = there.in_front[0] & (place > -0.5).all(dim=-1) & (place < limit).all(dim=-1)
    grid = (2 * (place + 0.5) / (limit + 0.5) - 1).view(1, 1, -1, 2)

    def look_up(image: Tensor, mode: str) -> Tensor:
        return F.grid_sample(
            image[None], grid, mode=mode, padding_mode="border", align_corners=False
        )[0, :, 0]

    # Inverse depth is affine on a plane: bilinear reading is exact there, also when it slants.
    inverse = 1 / room.depth[source, None]
    ratio = 1 / (look_up(inverse, "bilinear")[0] * expected)
    # Beside a silhouette it reads two surfaces at once.
    reach = F.max_pool2d(torch.cat([inverse, -inverse]), 3, stride=1, padding=1)
    inside &= look_up((reach[:1] / -reach[1:] > 1.1).float(), "bilinear")[0] == 0
    colour = look_up(room.images[source].float(), "bilinear")
    difference = (colour - room.images[anchor].float().flatten(1)).abs().mean(dim=0)
    return ratio, difference, inside


def extent(solids: Solids, points: Tensor) -> Tensor:
    """How far out world points ``(3, P)`` are in each solid, ``(N, P)``; 1 is the surface."""
    offset = points - solids.centre.double()[..., None]  # (N, 3, P)
    local = (solids.local_from_world.double() @ offset) / solids.half_size.double()[..., None]
    x, y, z = local.abs().unbind(dim=1)
    by_shape = {
        BOX: torch.maximum(torch.maximum(x, y), z),
        ELLIPSOID: (x * x + y * y + z * z).sqrt(),
        CYLINDER: torch.maximum(torch.hypot(x, z), y),
    }
    return torch.stack([by_shape[shape][n] for n, shape in enumerate(solids.shape.tolist())])
