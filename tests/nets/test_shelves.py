"""Rooms that wait in memory: which room a place sees, whoever holds the place."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.utils.data import Dataset

from deltas_geom import PosedViews
from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.config import DataConfig, TrainConfig
from deltas_nets.rooms import Rooms
from deltas_nets.train.loader import Part, StepSampler, step_loader
from deltas_nets.train.shelves import Shelves, places_with_new_rooms

# Fresh rooms per step, steps between a place's new rooms, rooms on a shelf.
sizes = st.tuples(st.integers(1, 3), st.integers(1, 5), st.integers(1, 4))


class Numbered(Rooms):
    """Rooms that hold nothing but their number."""

    def __getitem__(self, index: int) -> PosedImages:
        if not 0 <= index < len(self):
            raise IndexError(index)
        number = torch.full((2, 1, 1), float(index))
        views = PosedViews(torch.eye(3).repeat(2, 1, 1), torch.eye(4).repeat(2, 1, 1))
        return PosedImages(torch.zeros(2, 3, 1, 1, dtype=torch.uint8), views, number)


def config_of(fresh: int, replay: int, shelf: int) -> TrainConfig:
    data = DataConfig(num_rooms=10_000, num_views=2, workers=0, replay=replay, shelf=shelf)
    return TrainConfig(data=data, batch_size=fresh * replay, max_views=2)


def seen(config: TrainConfig, start: int, stop: int, part: Part = Part()) -> list[list[int]]:  # noqa: B008
    data: Dataset[PosedImages] = Numbered(config.data.num_rooms)
    steps = step_loader(data, config, start=start, stop=stop, part=part)  # type: ignore[arg-type]
    return [rooms.depth[:, 0, 0, 0].int().tolist() for rooms in steps]


def given_to_places(config: TrainConfig, stop: int) -> list[list[int]]:
    """Rooms that each place was given before ``stop``, in order."""
    data, count = config.data, config.batch_size
    begin = 1 - data.replay
    sampler = StepSampler(
        data.num_rooms, count, seed=config.seed, start=begin, stop=stop, replay=data.replay
    )
    given_rooms: list[list[int]] = [[] for _ in range(count)]
    for step, rooms in zip(range(begin, stop), sampler, strict=True):
        places = places_with_new_rooms(step, range(count), data.replay)
        for place, room in zip(places, rooms, strict=True):
            given_rooms[place].append(room)
    return given_rooms


@given(sizes, st.integers(0, 12))
@settings(deadline=None)
def test_a_place_sees_one_of_the_last_rooms_that_it_was_given(
    size: tuple[int, int, int], step: int
) -> None:
    config = config_of(*size)
    (rooms,) = seen(config, step, step + 1)
    for room, mine in zip(rooms, given_to_places(config, step + 1), strict=True):
        assert room in mine[-config.data.shelf :]


@given(sizes)
@settings(deadline=None)
def test_every_room_is_given_once_and_every_step_brings_equally_many(
    size: tuple[int, int, int],
) -> None:
    config = config_of(*size)
    given_rooms = [room for rooms in given_to_places(config, 9) for room in rooms]
    assert len(set(given_rooms)) == len(given_rooms)
    assert len(given_rooms) == size[0] * (9 + config.data.replay - 1)


@given(sizes, st.integers(1, 9))
@settings(deadline=None)
def test_a_run_that_goes_on_sees_what_an_unbroken_one_does(
    size: tuple[int, int, int], start: int
) -> None:
    config = config_of(*size)
    assert seen(config, start, 10) == seen(config, 0, 10)[start:]


@given(sizes)
@settings(deadline=None)
def test_parts_of_the_places_see_what_the_whole_does(size: tuple[int, int, int]) -> None:
    config = config_of(2 * size[0], *size[1:])
    whole = seen(config, 2, 6)
    parts = [seen(config, 2, 6, Part(number, 2)) for number in (0, 1)]
    assert [first + second for first, second in zip(*parts, strict=True)] == whole


def test_without_replay_each_step_has_rooms_of_its_own() -> None:
    rooms = [room for step in seen(config_of(3, 1, 1), 0, 5) for room in step]
    assert len(set(rooms)) == 15


def test_rooms_are_used_about_as_often_as_asked_for() -> None:
    config = config_of(4, 4, 6)
    rooms = [room for step in seen(config, 0, 200) for room in step]
    assert 3.2 < len(rooms) / len(set(rooms)) < 5


def test_another_seed_takes_other_rooms() -> None:
    config = config_of(2, 3, 3)
    assert seen(config, 5, 6) != seen(replace(config, seed=1), 5, 6)


def test_a_place_of_its_own_may_get_nothing_new_in_a_step() -> None:
    config = config_of(1, 4, 3)
    whole = seen(config, 3, 9)
    alone = [seen(config, 3, 9, Part(number, 4)) for number in range(4)]
    assert [
        [room for place in places for room in place] for places in zip(*alone, strict=True)
    ] == whole


def test_a_finished_run_reads_nothing() -> None:
    class Counting(Numbered):
        read = 0

        def __getitem__(self, index: int) -> PosedImages:
            Counting.read += 1
            return super().__getitem__(index)

    config = config_of(2, 4, 6)
    assert list(step_loader(Counting(100), config, start=7, stop=7)) == []
    assert Counting.read == 0


def test_nothing_is_taken_before_something_was_put() -> None:
    shelves = Shelves(range(2), 3, 2, seed=0)
    assert shelves.first_step(0) == -1
    assert shelves.first_step(20) == 15
    with pytest.raises(AssertionError, match="put comes first"):
        shelves.take(0)
