"""Maps that agree: what one sees from another's place, what most say, who hears whom."""

import itertools
import math
from itertools import pairwise

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import PosedViews, project
from deltas_geom.cameras.pixels import pixel_grid
from deltas_geom.testing.strategies import vectors
from deltas_nets.agree.agreed import agreed
from deltas_nets.agree.consensus import LEAST, TOLERANCE, consensus
from deltas_nets.agree.heard import Heard
from deltas_nets.agree.hidden import SAME, hidden, votes
from deltas_nets.agree.neighbours import neighbours, sample
from deltas_nets.agree.other_image import hit, motion
from deltas_nets.agree.seen_from import seen_from
from deltas_nets.network.known_depth import KnownDepth

SIZE = (24, 32)
K = torch.tensor([[30.0, 0, 15.5], [0, 30, 11.5], [0, 0, 1]], dtype=torch.float64)
seeds = st.integers(0, 1000)


def camera(x: float, z: float = 0.0, turn: float = 0.0) -> PosedViews:
    """A camera at (x, 0, z) that is turned about y."""
    cam_from_world = torch.eye(4, dtype=torch.float64)
    cos, sin = math.cos(turn), math.sin(turn)
    cam_from_world[:3, :3] = torch.tensor([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]])
    cam_from_world[:3, 3] = -cam_from_world[:3, :3] @ torch.tensor([x, 0, z], dtype=torch.float64)
    return PosedViews(K[None], cam_from_world[None])


def wall(view: PosedViews, distance: float = 3.0) -> Tensor:
    """Depth ``(1, 1, H, W)`` of the plane z = distance."""
    rows, columns = torch.meshgrid(*map(torch.arange, SIZE), indexing="ij")
    rays = torch.stack([columns, rows, torch.ones(SIZE)], dim=-1).double() @ torch.inverse(K).mT
    in_world = rays @ view.cam_from_world[0, :3, :3]
    centre = -view.cam_from_world[0, :3, :3].mT @ view.cam_from_world[0, :3, 3]
    return ((distance - centre[2]) / in_world[..., 2])[None, None]


def sure(depth: Tensor, deviation: float = 0.02) -> KnownDepth:
    return KnownDepth(depth, torch.full_like(depth, deviation))


@given(vectors(20, within=4.0), st.floats(-0.5, 0.5))
def test_points_fall_on_the_pixel_whose_centre_is_nearest(points: Tensor, turn: float) -> None:
    """Beside projections, of points around the camera."""
    here, there = camera(0), camera(0.2, 0.1, turn)
    turns, shift = motion(here, there, like=points)
    x, y, z = (
        turns[0] @ (here.K[0] @ points.mT) + shift[0]
    ).unbind()  # in front of ``here`` or not
    found, seen = hit(x, y, z, image_size=SIZE), project(there, points)
    assert_close(z, seen.depth[0])
    centres = pixel_grid(SIZE, dtype=torch.float64).reshape(-1, 2)
    off, nearest = (seen.pixels[0][:, None] - centres).abs().amax(dim=-1).min(dim=-1)
    sure = (off - 0.5).abs() > 1e-9  # on an edge between pixels, rounding decides
    inside = seen.in_front[0] & (off < 0.5)
    assert torch.equal(found.inside[sure], inside[sure])
    assert torch.equal(found.place[sure], torch.where(inside, nearest, 0)[sure])


@given(st.floats(-0.4, 0.4), st.floats(-0.5, 0.5), st.floats(-0.1, 0.1))
def test_a_wall_is_the_same_wall_from_elsewhere(x: float, z: float, turn: float) -> None:
    other, anchor = camera(x, z, turn), camera(0)
    seen = seen_from(sure(wall(other), 0.07), other, anchor, image_size=SIZE)
    known = seen.depth > 0
    assert known.double().mean() > 0.4
    # Points fall beside the centres of pixels; of a wall that is seen at a slant that is a step.
    assert_close(seen.depth[known], wall(anchor)[known], rtol=5e-3, atol=0)
    assert_close(seen.deviation[known], torch.full_like(seen.deviation[known], 0.07))


def test_the_nearer_of_two_hides_the_other() -> None:
    depth = wall(camera(0.3))
    depth[..., 12:, :] = 1.0
    seen = seen_from(sure(depth), camera(0.3), camera(0), image_size=SIZE).depth[0, 0]
    assert ((seen - 1).abs() < 1e-9).any() and ((seen - 3).abs() < 1e-9).any()
    assert (((seen - 1).abs() < 1e-9) | ((seen - 3).abs() < 1e-9) | (seen == 0)).all()


@given(seeds)
def test_of_points_of_one_depth_the_surest_is_drawn(seed: int) -> None:
    random = torch.Generator().manual_seed(seed)
    depth = torch.full((1, 1, *SIZE), 3.0, dtype=torch.float64)
    deviation = torch.rand(depth.shape, generator=random).double() + 0.01
    # From twice as far four points fall on a pixel, all of them 6 m away.
    seen = seen_from(KnownDepth(depth, deviation), camera(0), camera(0, z=-3.0), image_size=SIZE)
    wanted = torch.full(SIZE, torch.inf, dtype=torch.float64)
    for row, column in itertools.product(*map(range, SIZE)):
        place = math.floor((row + 11.5) / 2 + 0.5), math.floor((column + 15.5) / 2 + 0.5)
        wanted[place] = torch.minimum(wanted[place], deviation[0, 0, row, column])
    known = wanted < torch.inf
    assert known.sum() < depth.numel() / 3
    assert_close(seen.depth[0, 0], torch.where(known, 6.0, 0.0).double())
    assert_close(seen.deviation[0, 0], torch.where(known, wanted, 0.0))


@given(seeds, st.integers(LEAST, 6))
def test_what_most_say_does_not_depend_on_their_order(seed: int, count: int) -> None:
    random = torch.Generator().manual_seed(seed)
    depth = (0.05 * torch.randn(count, 1, 5, 6, generator=random, dtype=torch.float64)).exp()
    maps = KnownDepth(depth, 0.02 + 0.1 * torch.rand(depth.shape, generator=random).double())
    found = consensus(maps)
    order = torch.randperm(count, generator=random)
    other = consensus(KnownDepth(*(part[order] for part in maps)))
    assert_close(found.depth, other.depth)
    assert_close(found.deviation, other.deviation)


@given(seeds, st.floats(0.5, 2).filter(lambda s: abs(math.log(s)) > 3 * TOLERANCE))
def test_three_that_agree_outvote_one_and_two_do_not(seed: int, scale: float) -> None:
    random = torch.Generator().manual_seed(seed)
    depth = 2 + torch.rand(1, 1, 4, 5, generator=random, dtype=torch.float64)
    three = torch.cat([depth, depth, depth, depth * scale])
    found = consensus(sure(three))
    assert_close(found.depth, depth[0])
    assert_close(found.deviation, torch.full_like(depth[0], 0.02))
    assert not consensus(sure(three[1:])).depth.any()


def same_place(depth: Tensor, deviation: float = 0.02) -> list[Heard]:
    """Maps ``(V, 1, H, W)`` whose cameras stand where the anchor's does."""
    views = PosedViews(*(part.expand(len(depth), *part.shape[1:]) for part in camera(0)))
    return [Heard(sure(depth, deviation), views)]


def test_a_map_takes_what_three_others_say_and_moves_the_rest_as_they_would() -> None:
    truth = wall(camera(0))
    own = sure(truth[0] * 1.2, 0.1)
    others = truth.repeat(3, 1, 1, 1)
    others[..., 20:] = 0  # nobody sees the right side
    found = agreed(own, camera(0), same_place(others))
    assert_close(found.depth[..., :20], truth[0, ..., :20])
    left = (found.depth[0, :, 20:] / truth[0, 0, :, 20:] - 1).mean(dim=0)
    assert (left.diff() > 0).all() and 0 < left[0] < 0.06 and left[-1] < 0.15
    assert_close(found.deviation[..., 20:], own.deviation[..., 20:])


def test_maps_of_two_sizes_are_heard_together() -> None:
    truth = wall(camera(0))
    own = sure(truth[0] * 1.2, 0.1)
    together = agreed(own, camera(0), same_place(truth.repeat(3, 1, 1, 1)))
    apart = agreed(own, camera(0), same_place(truth) + same_place(truth.repeat(2, 1, 1, 1)))
    assert_close(apart.depth, together.depth)


def test_holes_of_a_map_are_filled_or_stay_holes() -> None:
    truth = wall(camera(0))
    depth = truth[0] * 1.2
    depth[..., 5:15, 5:15], depth[..., 5:15, 22:32] = 0, 0
    others = truth.repeat(3, 1, 1, 1)
    others[..., 20:] = 0
    own = KnownDepth(depth, torch.full_like(depth, 0.1))
    found = agreed(own, camera(0), same_place(others))
    assert found.depth.isfinite().all() and found.deviation.isfinite().all()
    assert_close(found.depth[..., 5:15, 5:15], truth[0, ..., 5:15, 5:15])
    assert not found.depth[..., 5:15, 22:32].any()


def test_a_map_that_nobody_sees_stays() -> None:
    own = sure(wall(camera(0))[0])
    assert agreed(own, camera(0), same_place(torch.zeros(2, 1, *SIZE).double())) is own
    assert agreed(own, camera(0), []) is own


def box_before_a_wall(view: PosedViews, *, box: bool) -> Tensor:
    """A wall at 3 m and, if a box is there, 1 m before the camera what is nearer than x = 0.1."""
    depth = wall(view)
    if box:
        near = wall(view, 1.0)
        columns = torch.arange(SIZE[1], dtype=torch.float64)
        x = (columns - K[0, 2]) / K[0, 0] - view.cam_from_world[0, 0, 3]
        depth = torch.where(x < 0.1, near, depth)
    return depth


@given(st.integers(3, 6), st.floats(0.1, 0.3), st.booleans())
def test_a_wall_behind_a_box_is_not_seen_however_many_agree(
    count: int, step: float, supported: bool
) -> None:
    anchor = camera(0)
    # From the right all look past the box to the wall that it hides from the anchor.
    right = [camera(0.7 + step * number / count) for number in range(count)]
    walls = torch.cat([wall(view) for view in right])
    beside = camera(0.02)
    others = [
        Heard(sure(walls), PosedViews(*(torch.cat(part) for part in zip(*right, strict=True)))),
        *([Heard(sure(box_before_a_wall(beside, box=True)), beside)] if supported else []),
    ]
    own = sure(box_before_a_wall(anchor, box=True)[0])
    found = agreed(own, anchor, others)
    assert_close(found.depth, own.depth, rtol=0.03, atol=0)


def test_a_box_that_the_others_look_through_is_not_there() -> None:
    anchor = camera(0)
    others = same_place(wall(anchor).repeat(3, 1, 1, 1))
    own = sure(box_before_a_wall(anchor, box=True)[0])
    found = agreed(own, anchor, others)
    inner = found.depth[..., :14]  # beside the edge the own map knows best
    assert_close(inner, wall(anchor)[0][..., :14], rtol=0.03, atol=0)


@pytest.mark.parametrize("through", [1, 2])
def test_a_nearer_thing_needs_no_fewer_who_see_it_than_look_through(through: int) -> None:
    far, near = torch.full((1, *SIZE), 3.0).double(), torch.full((1, *SIZE), 1.0).double()
    others = same_place(torch.cat([near[None]] + [far[None]] * through))
    gone = hidden(far, near, camera(0), others)
    assert gone.all() if through == 2 else not gone.any()


@pytest.mark.parametrize("through", [4, 5])
def test_what_is_behind_is_seen_if_over_four_times_as_many_look_through(through: int) -> None:
    far, near = torch.full((1, *SIZE), 3.0).double(), torch.full((1, *SIZE), 1.0).double()
    others = same_place(torch.cat([near[None]] + [far[None]] * through))
    behind = hidden(near, far, camera(0), others)
    assert behind.all() if through == 4 else not behind.any()


@given(st.floats(0.3, 3))
def test_votes_are_for_against_or_none(scale: float) -> None:
    depth = torch.full((1, *SIZE), 2.0).double()
    others = same_place(depth[None] * scale)
    said = votes(depth, torch.arange(depth.numel()), camera(0), others)
    off = math.log(scale)
    expected = (0.02**-2 * (abs(off) < SAME), 0.02**-2 * (off >= SAME))
    assert_close(said.support, torch.full_like(said.support, expected[0]))
    assert_close(said.against, torch.full_like(said.against, expected[1]))


def test_neighbours_are_those_that_share_most() -> None:
    places = [0.0, 0.4, 1.1, 1.5, 40.0]
    views = [camera(x) for x in places]
    points = torch.stack([sample(wall(view)[0], view) for view in views])
    cameras = PosedViews(*(torch.cat(parts) for parts in zip(*views, strict=True)))
    found = neighbours(points, cameras, [SIZE] * 5)
    assert found[4] == []
    for own, near in enumerate(found[:4]):
        apart = [abs(places[other] - places[own]) for other in near]
        # A sample is 0.35 m wide.
        assert all(far > close - 0.36 for close, far in pairwise(apart))
        assert own not in near and 4 not in near
        assert all(own in found[other] for other in near)


def test_of_cameras_that_stand_in_one_place_one_is_heard() -> None:
    views = [camera(x) for x in (0.0, 0.004, 0.4, 0.404, 0.408, 0.8)]
    points = torch.stack([sample(wall(view)[0], view) for view in views])
    cameras = PosedViews(*(torch.cat(parts) for parts in zip(*views, strict=True)))
    found = neighbours(points, cameras, [SIZE] * 6, apart=0.005)  # of a wall 3 m away: 15 mm
    assert [len(near) for near in found] == [2] * 6
    assert set(found[0]) & {2, 3, 4} and 5 in found[0]
    assert set(found[5]) & {0, 1} and set(found[5]) & {2, 3, 4}
    assert all(len(near) == 5 for near in neighbours(points, cameras, [SIZE] * 6))


def test_what_has_no_depth_is_seen_by_nobody() -> None:
    behind = camera(0.0, -1.0)  # it sees where the other camera stands
    views = [camera(0.0), behind]
    empty, half = torch.zeros(1, *SIZE), wall(views[0])[0]
    half[..., : SIZE[1] // 2] = 0.0
    cameras = PosedViews(*(torch.cat(parts) for parts in zip(*views, strict=True)))

    def shared(first: Tensor, second: Tensor) -> list[list[int]]:
        points = torch.stack([sample(first, views[0]), sample(second, views[1])])
        return neighbours(points, cameras, [SIZE] * 2)

    whole = wall(behind)[0]
    assert shared(half, whole) == [[1], [0]]
    assert shared(empty, whole) == shared(half, empty) == shared(empty, empty) == [[], []]


@pytest.mark.parametrize("size", [(24, 32), (40, 91)])
def test_samples_lie_on_what_the_map_shows(size: tuple[int, int]) -> None:
    points = sample(torch.full((1, *size), 2.0), camera(0.7, 0.4))
    assert points.shape == (64, 3) and len(points.unique(dim=0)) == 64
    assert_close(points[:, 2], torch.full((64,), 2.4).double())
