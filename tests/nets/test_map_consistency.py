"""Maps of one scene that agree, and maps that do not."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from torch import Tensor

from deltas_geom import PosedViews
from deltas_nets.captures.frame import Frame, Lens
from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.evaluate.consistency import (
    SeenMaps,
    agreeing_share,
    flicker_of_pair,
    same_places,
    shrunk,
)
from deltas_nets.rooms import render_room

WALL = 2.0
SIZE = (24, 32)


@pytest.fixture(scope="module")
def room() -> PosedImages:
    return render_room(0, num_views=4, image_size=(48, 64))


def frame(room: PosedImages, id: int) -> Frame:
    K, pose = (part[id].double().numpy() for part in room.views)
    return Frame(str(id), None, (48, 64), K, pose)  # type: ignore[arg-type]


def seen(
    room: PosedImages,
    scales: list[float],
    lens: Lens | None = None,
    holes: Callable[[tuple[int, ...]], NDArray[np.bool_]] = np.zeros,
) -> SeenMaps:
    """The maps of a room, each its true depth at some scale, but in holes."""
    maps = SeenMaps()
    for id, scale in enumerate(scales):
        truth = room.depth[id].numpy()
        given = frame(room, id)
        object.__setattr__(given, "lens", lens)
        depth = np.where(holes(truth.shape), 0, np.float32(scale) * truth)
        maps.add(given, depth, truth)
    return maps


def moved(pose: Tensor, units: float) -> Tensor:
    pose = pose.clone()
    pose[..., :3, 3] *= units
    return pose


def camera(x: float) -> PosedViews:
    K = torch.tensor([[[32.0, 0, 15.5], [0, 32, 11.5], [0, 0, 1]]]).double()
    pose = torch.eye(4).double()[None].clone()
    pose[0, 0, 3] = -x
    return PosedViews(K, pose)


@given(scale=st.floats(0.8, 1.25))
@settings(max_examples=30)
def test_walls_agree_as_far_as_their_depths_do(scale: float) -> None:
    wall = np.full(SIZE, WALL, np.float32)
    share = agreeing_share(camera(0), wall, camera(0.25), np.float32(scale) * wall)
    assert share == (1.0 if abs(scale - 1) < 0.05 else 0.0) or abs(abs(scale - 1) - 0.05) < 1e-4


def test_what_the_other_has_no_depth_for_does_not_count() -> None:
    wall = np.full(SIZE, WALL, np.float32)
    half = wall.copy()
    half[:, 16:] = 0
    half[:, :8] = 3
    # The other stands 0.25 m to the right: the wall is 4 pixels farther left there, so of the first
    # 16 columns 8 show something else and 8 the wall.
    assert agreeing_share(camera(0), wall, camera(0.25), half) == pytest.approx(8 / 16)
    assert np.isnan(agreeing_share(camera(0), wall, camera(0.25), 0 * wall))


@pytest.mark.parametrize("x", [0.22, 0.25, 0.28])  # 3.5 to 4.5 pixels
def test_places_are_found_where_parallax_puts_them(x: float) -> None:
    wall = np.full(SIZE, WALL, np.float32)
    here, there = same_places(camera(0), wall, camera(x), wall)
    rows, columns = np.divmod(here, SIZE[1])
    assert np.array_equal(there, rows * SIZE[1] + columns - 4)
    assert columns.min() == 4
    assert len(here) == SIZE[0] * (SIZE[1] - 4)
    nearer = np.float32(0.97) * wall
    assert len(same_places(camera(0), wall, camera(x), nearer)[0]) == 0


def test_flicker_is_told_by_depth_in_range_in_any_unit() -> None:
    wall, units = np.full((48, 64), WALL, np.float32), 1e-4
    views = [camera(0.25 * x) for x in range(2)]
    near = [v._replace(cam_from_world=moved(v.cam_from_world, units)) for v in views]
    found = []
    for cameras, unit, depths in ((views, 1.0, (0.5, 10.0)), (near, units, (5e-5, 1e-3))):
        maps = [np.float32(unit * scale) * wall for scale in (1, 1.1)]
        truth = np.float32(unit) * wall
        one, other = zip(cameras, maps, (truth, truth), strict=True)
        found.append(flicker_of_pair(one, other, depth_range=depths))
    assert found[0] == pytest.approx(np.log(1.1), rel=1e-5)
    assert found[1] == pytest.approx(found[0], rel=1e-5)


def test_true_maps_agree_as_the_truth_does_and_do_not_flicker(room: PosedImages) -> None:
    found = seen(room, [1, 1, 1, 1]).result()
    assert found.agreement == found.truth
    assert found.agreement is not None and found.agreement > 0.5
    assert found.flicker == 0
    assert found.pairs > 0
    assert found.successive == 3


def test_a_common_scale_flickers_not_and_changing_ones_do(room: PosedImages) -> None:
    assert seen(room, [1.1] * 4).result().flicker == pytest.approx(0, abs=1e-6)
    found = seen(room, [1, 1.2, 1, 1.2]).result()
    assert found.flicker == pytest.approx(np.log(1.2), abs=1e-6)
    assert found.agreement is not None and found.truth is not None
    assert found.agreement < 0.8 * found.truth


@pytest.mark.parametrize("share", [0.0, 0.5, 0.9, 1.0])
def test_holes_do_not_hide_flicker(room: PosedImages, share: float) -> None:
    random = np.random.default_rng(0)
    found = seen(room, [1.1, 0.9, 1.1, 0.9], holes=lambda size: random.random(size) < share)
    if share == 1:
        assert found.result().flicker is None
    else:
        assert found.result().flicker == pytest.approx(np.log(1.1 / 0.9), abs=1e-6)


def test_one_map_and_bent_lines_say_nothing(room: PosedImages) -> None:
    for maps in (seen(room, [1]), seen(room, [1, 1, 1], Lens("SIMPLE_RADIAL", (0.1,)))):
        found = maps.result()
        assert found.agreement is found.truth is found.flicker is None
        assert found.pairs == found.successive == 0


def test_shrinking_keeps_values_and_places() -> None:
    image = np.arange(12, dtype=np.float32).reshape(3, 4)
    assert np.array_equal(shrunk(image.repeat(6, 0).repeat(6, 1), (3, 4)), image)
    assert np.array_equal(shrunk(image, (1, 2)), image[1:2, 1::2])
