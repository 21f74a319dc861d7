"""Plane sweep and semi-global matching: its parts beside plain ones, and depth of a room."""

import itertools

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import PosedViews
from deltas_nets.baselines.plane_sweep import SweepConfig, plane_sweep
from deltas_nets.baselines.sweep.semi_global import Penalties, aggregate
from deltas_nets.baselines.sweep.similarity import similarity_volume
from deltas_nets.baselines.sweep.smoothing import Smoothing, filled
from deltas_nets.baselines.sweep.winner import winner
from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.rooms import render_room

SIZE = (96, 128)
PATHS = [step for step in itertools.product((-1, 0, 1), repeat=2) if step != (0, 0)]


@pytest.fixture(scope="module")
def whole_room() -> PosedImages:
    """A room as rendered, of three views."""
    return render_room(5000, num_views=3, image_size=(2 * SIZE[0], 2 * SIZE[1]))


@pytest.fixture(scope="module")
def room(whole_room: PosedImages) -> PosedImages:
    """The same, smaller."""
    images, views, depth = whole_room
    images = F.avg_pool2d(images.float(), 2).round().byte()
    views = views.resize(old_size=(2 * SIZE[0], 2 * SIZE[1]), new_size=SIZE)
    return PosedImages(images, views, depth[:, ::2, ::2])


def grey_of(room: PosedImages) -> Tensor:
    return room.images.float().mean(dim=1, keepdim=True) / 255


@st.composite
def costs(draw: st.DrawFn) -> tuple[Tensor, Tensor, Penalties]:
    """A volume of few planes and pixels, an image, and penalties."""
    planes, height, width = (draw(st.integers(1, 4)) for _ in range(3))
    numbers = st.lists(
        st.floats(0, 1, width=32),
        min_size=(planes + 1) * height * width,
        max_size=(planes + 1) * height * width,
    )
    volume = torch.tensor(draw(numbers), dtype=torch.float64).reshape(planes + 1, height, width)
    penalties = Penalties(draw(st.floats(0, 1)), draw(st.floats(0, 2)), draw(st.floats(0.1, 1)))
    return volume[1:], volume[0], penalties


def plain_aggregate(cost: Tensor, guide: Tensor, penalties: Penalties) -> Tensor:
    """Equation 13 of the paper, pixel by pixel and path by path, by recursion."""
    planes, height, width = cost.shape

    def along(row: int, column: int, step: tuple[int, int]) -> list[float]:
        before = (row - step[0], column - step[1])
        here = cost[:, row, column].tolist()
        if not (0 <= before[0] < height and 0 <= before[1] < width):
            return here
        past = along(*before, step)
        contrast = abs(float(guide[row, column] - guide[before]))
        jump = max(penalties.step, penalties.jump / (1 + contrast / penalties.contrast))
        return [
            here[plane]
            + min(
                past[other] + (0, penalties.step)[abs(other - plane)]
                if abs(other - plane) <= 1
                else past[other] + jump
                for other in range(planes)
            )
            - min(past)
            for plane in range(planes)
        ]

    total = torch.zeros_like(cost)
    for row, column, step in itertools.product(range(height), range(width), PATHS):
        total[:, row, column] += torch.tensor(along(row, column, step), dtype=cost.dtype)
    return total


@given(costs())
def test_eight_paths_are_those_of_the_plain_recursion(
    given: tuple[Tensor, Tensor, Penalties],
) -> None:
    cost, guide, penalties = given
    assert_close(aggregate(cost, guide, penalties), plain_aggregate(cost, guide, penalties))


@given(costs())
def test_a_constant_more_at_every_plane_changes_no_winner(
    given: tuple[Tensor, Tensor, Penalties],
) -> None:
    cost, guide, penalties = given
    more = aggregate(cost + 0.5, guide, penalties) - aggregate(cost, guide, penalties)
    assert_close(more, torch.full_like(more, 0.5 * len(PATHS)))


def test_the_winner_of_a_parabola_is_its_vertex() -> None:
    planes = torch.arange(8.0)[:, None, None]
    vertex = torch.tensor([[2.3, 5.0, 6.4]])
    found = winner((planes - vertex).square())
    assert_close(found.place, vertex)
    assert (found.margin > 0).all()
    # At either end there is no plane beyond, and no parabola.
    assert winner(planes).place.item() == 0 and winner(-planes).place.item() == 7


def test_equal_costs_leave_no_margin() -> None:
    assert winner(torch.zeros(8, 2, 2)).margin.eq(0).all()


def test_filling_solves_the_least_squares_of_every_row() -> None:
    """One round of one row beside a dense solve."""
    random = np.random.default_rng(0)
    values, weight, guide = (torch.from_numpy(random.random((1, 6))) for _ in range(3))
    smoothing = Smoothing(strength=2.0, contrast=0.3)
    tie = torch.zeros(6, 6, dtype=torch.float64)
    for left in range(5):
        share = torch.exp(-(guide[0, left] - guide[0, left + 1]).abs() / smoothing.contrast)
        tie[left, left] += share
        tie[left + 1, left + 1] += share
        tie[left, left + 1] -= share
        tie[left + 1, left] -= share
    numerator, denominator = values[0] * weight[0], weight[0]
    for number in range(3):
        strength = smoothing.strength * 1.5 * 4.0 ** (2 - number) / (4.0**3 - 1)
        system = torch.eye(6, dtype=torch.float64) + strength * tie
        numerator, denominator = (
            torch.linalg.solve(system, each) for each in (numerator, denominator)
        )
    assert_close(filled(values, weight, guide, smoothing)[0], numerator / denominator)


@given(st.floats(0.1, 9), st.integers(0, 5), st.integers(0, 7))
def test_one_believed_pixel_fills_an_image_without_edges(
    value: float, row: int, column: int
) -> None:
    weight = torch.zeros(6, 8, dtype=torch.float64)
    weight[row, column] = 0.3
    values = torch.where(weight > 0, value, torch.nan)
    found = filled(values, weight, torch.zeros_like(weight), Smoothing(100.0, 0.03))
    assert_close(found, torch.full_like(found, value), rtol=1e-6, atol=0)


def test_nothing_believed_is_no_nan() -> None:
    none = torch.zeros(4, 5)
    assert filled(torch.ones(4, 5), none, none, Smoothing(100.0, 0.03)).isfinite().all()


def test_the_same_place_is_alike_and_light_does_not_matter(room: PosedImages) -> None:
    """An image beside itself, brighter: the correlation is 1 but for what noise allows."""
    grey = grey_of(room)[:1]
    views = PosedViews(room.views.K[[0, 0]], room.views.cam_from_world[[0, 0]])
    pair = torch.cat([grey, 0.8 * grey + 0.1])
    alike = similarity_volume(pair, views, torch.tensor([0.2, 1.0]), window=7, noise=1e-4)
    assert alike.amax() <= 1
    assert alike.median() > 0.99
    assert (alike[0] - alike[1]).abs().median() < 1e-3  # without baseline depth says nothing


def test_windows_correlate_as_numpy_says(room: PosedImages) -> None:
    grey = grey_of(room)[:2]
    views = PosedViews(room.views.K[[0, 0]], room.views.cam_from_world[[0, 0]])
    found = similarity_volume(grey, views, torch.tensor([1.0]), window=5, noise=0.0)[0, 40, 60]
    windows = [image[38:43, 58:63].flatten().double().numpy() for image in grey[:, 0]]
    assert abs(found.item() - np.corrcoef(*windows)[0, 1]) < 1e-3


def test_a_room_is_found_within_the_spacing_of_the_planes(whole_room: PosedImages) -> None:
    config = SweepConfig()
    images, views, depth = whole_room
    found = plane_sweep(images.float() / 255, views, (0.5, 10.0), config)
    spacing = (1 / 0.5 - 1 / 10.0) / (config.planes - 1)
    error = (1 / found.depth - 1 / depth[0]).abs() / spacing
    assert error.median() < 1
    believed = error[found.believed]
    assert len(believed) > 0.1 * error.numel()
    assert believed.median() < 0.5  # between planes
    assert (believed < 2).float().mean() > 0.9


def test_the_order_of_sources_does_not_matter(room: PosedImages) -> None:
    images, order = room.images.float() / 255, [0, 2, 1]
    one = plane_sweep(images, room.views, (0.5, 10.0), SweepConfig(planes=24))
    other = plane_sweep(
        images[order], room.views.select(order), (0.5, 10.0), SweepConfig(planes=24)
    )
    same = (one.depth / other.depth - 1).abs() < 1e-3
    assert same.float().mean() > 0.999  # sums of another order round differently


@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_frames_without_texture_get_a_depth_in_range(level: float, room: PosedImages) -> None:
    found = plane_sweep(
        torch.full((3, 3, *SIZE), level), room.views, (0.5, 10.0), SweepConfig(planes=24)
    )
    assert ((found.depth >= 0.499) & (found.depth <= 10.01)).all()
    assert not found.believed.any()


def test_a_source_that_looks_away_changes_nothing(room: PosedImages) -> None:
    images = room.images[:2].float() / 255
    # Turned by 80 degrees: what the anchor sees is beside the image, or behind it.
    cosine, sine = 0.1736, 0.9848
    turn = torch.tensor([[cosine, 0, sine, 0], [0, 1, 0, 0], [-sine, 0, cosine, 0], [0, 0, 0, 1]])
    turned = turn @ room.views.cam_from_world[:1]
    views = PosedViews(
        torch.cat([room.views.K[:2], room.views.K[:1]]),
        torch.cat([room.views.cam_from_world[:2], turned]),
    )
    config = SweepConfig(planes=24)
    alone = plane_sweep(images, room.views.select([0, 1]), (0.5, 10.0), config)
    beside = plane_sweep(torch.cat([images, images[:1]]), views, (0.5, 10.0), config)
    assert_close(alone.depth, beside.depth)
