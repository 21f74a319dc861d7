"""Repeatability of points under known depth and poses."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import maximum_bipartite_matching
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import PosedViews
from deltas_geom.checks import ShapeError
from deltas_nets.evaluate.repeatability import (
    Repeatability,
    pooled,
    repeatability,
    strongest_points,
)
from deltas_nets.rooms import render_room

SIZE = (60, 80)
FOCAL, DEPTH = 50.0, 2.0


def row_of_two(shift: float, *, depth: float = DEPTH) -> PosedViews:
    """Two cameras side by side: what is at ``depth`` moves by ``shift`` px to the left."""
    K = torch.tensor([[FOCAL, 0, 39.5], [0, FOCAL, 29.5], [0, 0, 1]]).expand(2, 3, 3)
    pose = torch.eye(4).repeat(2, 1, 1)
    pose[1, 0, 3] = -shift * depth / FOCAL
    return PosedViews(K, pose)


def wall(depth: float = DEPTH) -> Tensor:
    return torch.full((2, *SIZE), depth)


def grid() -> Tensor:
    """Points 12 px apart, 20 px from the left border."""
    rows, columns = torch.arange(8.0, 60, 12), torch.arange(20.0, 80, 12)
    return torch.cartesian_prod(columns, rows)


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ShapeError, match="first must have shape"):
        repeatability(row_of_two(0), wall(), torch.zeros(5, 3), grid())
    with pytest.raises(ShapeError, match="depth must have shape"):
        repeatability(row_of_two(0), torch.zeros(3, 1), grid(), grid())


@given(points=st.lists(st.tuples(st.integers(0, 79), st.integers(0, 59)), min_size=1, max_size=30))
def test_a_view_repeats_all_of_itself(points: list[tuple[int, int]]) -> None:
    found = torch.tensor(points).float()
    score = repeatability(row_of_two(0), wall(), found, found)
    assert score.share == 1
    assert score.counted == 2 * len(points)
    assert_close(score.error, 0.0, rtol=0, atol=1e-4)


def test_a_room_seen_twice_repeats_all_known_points() -> None:
    room = render_room(3, num_views=2, image_size=(48, 64))
    views, depth = room.views.select([0, 0]), room.depth[[0, 0]]
    points = torch.cartesian_prod(torch.arange(4.0, 60, 7), torch.arange(3.0, 45, 6))
    assert repeatability(views, depth, points, points).share == 1


@given(shift=st.integers(-15, 15))
def test_points_moved_with_the_scene_are_repeated_exactly(shift: int) -> None:
    moved = grid() - torch.tensor([float(shift), 0])
    score = repeatability(row_of_two(shift), wall(), grid(), moved)
    assert score.share == 1
    assert score.error < 1e-3


@pytest.mark.parametrize(("off", "expected"), [(2.9, 1.0), (3.1, 0.0)])
def test_partners_are_within_three_pixels(off: float, expected: float) -> None:
    moved = grid() - torch.tensor([8.0, off])
    score = repeatability(row_of_two(8), wall(), grid(), moved)
    assert score.share == expected
    if expected:
        assert_close(score.error, off, rtol=0, atol=1e-3)
    else:
        assert math.isnan(score.error)


@given(shift=st.integers(-15, 15), seed=st.integers(0, 20))
def test_it_does_not_matter_which_view_is_first(shift: int, seed: int) -> None:
    random = torch.Generator().manual_seed(seed)
    first, second = (torch.rand(40, 2, generator=random) * 59 for _ in range(2))
    views = row_of_two(shift)
    forth = repeatability(views, wall(), first, second)
    back = repeatability(views.select([1, 0]), wall(), second, first)
    assert (forth.repeated, forth.counted) == (back.repeated, back.counted)
    assert (forth.paired, forth.fewer) == (back.paired, back.fewer)


@given(shift=st.integers(-15, 15), seed=st.integers(0, 20))
def test_pairs_are_fewer_than_the_most_that_can_be_made_and_at_least_half(
    shift: int, seed: int
) -> None:
    # Greedy pairs cannot be extended, and every one of them stands in the way of two at most.
    random = torch.Generator().manual_seed(seed)
    first = torch.rand(60, 2, generator=random) * torch.tensor([79.0, 59])
    second = first[:50] - torch.tensor([float(shift), 0]) + 2 * torch.rand(50, 2, generator=random)
    score = repeatability(row_of_two(shift), wall(), first, second)
    moved = first - torch.tensor([float(shift), 0])
    inside = (moved[:, 0] > -0.5) & (moved[:, 0] < 79.5)
    back = second + torch.tensor([float(shift), 0])
    near = torch.cdist(moved[inside], second[(back[:, 0] > -0.5) & (back[:, 0] < 79.5)]) <= 3
    most = int((maximum_bipartite_matching(csr_matrix(near.numpy())) >= 0).sum())
    assert most / 2 <= score.paired <= most
    assert score.paired <= score.fewer


def test_a_pair_is_near_in_both_views() -> None:
    # The second view sees everything twice as large: 2 px of the first are 4 px there.
    views = row_of_two(0)
    larger = views.K.clone()
    larger[1, 0, 0] = larger[1, 1, 1] = 2 * FOCAL
    views = views._replace(K=larger)
    first, off = torch.tensor([[35.0, 27]]), torch.tensor([[30.5 - 4, 24.5]])
    for pair in (
        repeatability(views, wall(), first, off),
        repeatability(views.select([1, 0]), wall(), off, first),
    ):
        assert (pair.repeated, pair.counted, pair.paired, pair.fewer) == (1, 2, 0, 1)


def test_a_cluster_repeats_but_has_one_partner() -> None:
    cluster = torch.tensor([[40.0, 30], [41, 30], [40, 31], [41, 31]])
    score = repeatability(row_of_two(0), wall(), cluster, cluster[:1] + 0.4)
    assert (score.repeated, score.counted) == (5, 5)
    assert (score.paired, score.fewer) == (1, 1)
    score = repeatability(row_of_two(0), wall(), cluster, torch.cat([cluster[:1], grid()]))
    assert score.paired == 1


def test_the_nearest_are_paired_first() -> None:
    # One after the other from the left, all three would be paired.
    first = torch.tensor([[20.0, 30], [24, 30], [50, 30]])
    second = torch.tensor([[22.9, 30], [26.9, 30], [50, 30]])
    assert repeatability(row_of_two(0), wall(), first, second).paired == 2


def test_the_share_counts_both_views() -> None:
    # Two of the second view's points have no partner; all of the first have one.
    second = torch.cat([grid() - torch.tensor([8.0, 0]), torch.tensor([[18.0, 2], [30, 2]])])
    score = repeatability(row_of_two(8), wall(), grid(), second)
    assert (score.repeated, score.counted) == (2 * len(grid()), 2 * len(grid()) + 2)


def test_points_outside_the_other_image_do_not_count() -> None:
    outside = torch.tensor([[3.0, 30], [5, 40]])  # would be at -7 and -5
    both = torch.cat([grid(), outside])
    score = repeatability(row_of_two(10), wall(), both, grid() - torch.tensor([10.0, 0]))
    assert (score.repeated, score.counted) == (2 * len(grid()), 2 * len(grid()))


def test_hidden_points_do_not_count_nor_serve_as_partners() -> None:
    depth = wall()
    depth[1, :, 40:] = 0.5 * DEPTH  # something stands before the right half of the second view
    moved = grid() - torch.tensor([8.0, 0])
    score = repeatability(row_of_two(8), depth, grid(), moved)
    left = int((moved[:, 0] < 40).sum())
    # From the second view: points on the near thing project where the first view sees the wall.
    assert 0 < left < len(grid())
    assert (score.repeated, score.counted) == (2 * left, 2 * left)


def test_points_without_depth_do_not_count() -> None:
    depth = wall(1.0)  # what is put in place of unknown depth must not pass for it
    depth[0, :30] = 0
    score = repeatability(row_of_two(0), depth, grid(), grid())
    low = int((grid()[:, 1] >= 30).sum())
    assert (score.repeated, score.counted) == (2 * low, 2 * low)


def test_points_behind_the_other_camera_do_not_count() -> None:
    views = row_of_two(0)
    around = views.cam_from_world.clone()
    around[1] = torch.diag(torch.tensor([-1.0, 1, -1, 1]))
    score = repeatability(views._replace(cam_from_world=around), wall(), grid(), grid())
    assert score.counted == 0
    assert math.isnan(score.share)


def test_no_points_are_no_error() -> None:
    score = repeatability(row_of_two(0), wall(), grid(), torch.zeros(0, 2))
    assert (score.repeated, score.counted) == (0, len(grid()))
    assert (score.paired, score.fewer) == (0, 0)
    assert math.isnan(score.one_to_one)


def test_pairs_are_pooled_by_their_points() -> None:
    total = pooled(
        [
            Repeatability(1, 2, 2.0, 1, 1),
            Repeatability(9, 10, 1.0, 3, 5),
            Repeatability(0, 8, math.nan, 0, 4),
        ]
    )
    assert total.share == 0.5
    assert total.one_to_one == 0.4
    assert_close(total.error, 1.1)


def test_strongest_points_are_apart_inside_and_in_order() -> None:
    scores = torch.rand(1, 1, *SIZE, generator=torch.Generator().manual_seed(0))
    points = strongest_points(scores, 20, nms_radius=3, border=5)
    assert len(points) == 20
    distance = (points[:, None] - points[None]).abs().amax(dim=-1) + 99 * torch.eye(20)
    assert distance.min() > 3
    assert (points >= 5).all()
    assert (points < torch.tensor([75, 55])).all()
    column, row = points.long().unbind(dim=-1)
    values = scores[0, 0, row, column]
    assert (values.diff() <= 0).all()


@pytest.mark.parametrize(
    ("column", "row", "inside"),
    [
        (5, 5, True),
        (74, 54, True),
        (4, 5, False),
        (75, 54, False),
        (5, 4, False),
        (74, 55, False),
    ],
)
def test_the_border_is_as_wide_on_all_sides(column: int, row: int, inside: bool) -> None:
    scores = torch.zeros(1, 1, *SIZE)
    scores[0, 0, row, column] = 1
    found = strongest_points(scores, border=5).tolist()
    assert found == ([[column, row]] if inside else [])


def test_a_flat_map_has_no_strongest_points() -> None:
    assert strongest_points(torch.zeros(1, 1, *SIZE)).shape == (0, 2)
