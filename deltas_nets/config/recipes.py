"""Whole trainings of `deltas-small`, from an encoder that knows pictures to weights to ship."""

from collections.abc import Callable
from dataclasses import replace
from typing import Literal, NamedTuple

from deltas_nets.config.training import DataConfig, TrainConfig

RecipeName = Literal["night", "hour"]
FEWEST_ROOMS = 2
"""To calibrate on, and to learn to redraw from."""


class Part(NamedTuple):
    """A training that starts from the weights of the part before.

    Attributes:
        name: of its folder.
        config: all of it, but for the teacher.
    """

    name: str
    config: TrainConfig


class Recipe(NamedTuple):
    """What is done one after the other.

    Attributes:
        parts: trainings.
        calibration_rooms: for each curve of the spread, which is fitted last.
        calibration_size: height and width of their images: where the weights will work.
        redraw_steps: of the stage that redraws (`deltas redraw`), the last thing that is trained.
        redraw_rooms: for it.
        redraw_sizes: height and width of their images.
    """

    parts: tuple[Part, ...]
    calibration_rooms: int = 200
    calibration_size: tuple[int, int] = (288, 384)
    redraw_steps: int = 1000
    redraw_rooms: int = 300
    redraw_sizes: tuple[tuple[int, int], ...] = ((288, 384), (240, 320))

    def scaled(self, effort: float) -> "Recipe":
        """Take a share of the steps and of the rooms to calibrate on, a few at least."""
        scaled = self._each(lambda c: replace(c, steps=max(1, round(effort * c.steps))))
        rooms = min(500, round(effort * self.calibration_rooms))
        return scaled._replace(
            calibration_rooms=max(FEWEST_ROOMS, rooms),
            redraw_steps=max(1, round(effort * self.redraw_steps)),
            redraw_rooms=max(FEWEST_ROOMS, round(effort * self.redraw_rooms)),
        )

    def taught_by(
        self, teacher: Literal["superpoint", "aliked", "disk", "xfeat", "deltas"]
    ) -> "Recipe":
        """Let it learn another detector's interest points."""
        return self._each(lambda c: replace(c, teacher=teacher))

    def with_workers(self, workers: int) -> "Recipe":
        """Let so many processes render; the result stays."""
        return self._each(lambda c: replace(c, data=replace(c.data, workers=workers)))

    def _each(self, change: Callable[[TrainConfig], TrainConfig]) -> "Recipe":
        parts = (part._replace(config=change(part.config)) for part in self.parts)
        return self._replace(parts=tuple(parts))


_EVERYTHING_AT_ONCE = TrainConfig(
    data=DataConfig(num_rooms=50_000, num_views=8, height=288, width=384, replay=16, shelf=24),
    steps=5500,
    sizes=((288, 384), (288, 384), (240, 320)),
    batch_size=64,
    learning_rate=1.5e-3,
    max_views=8,
    num_keypoints=512,
    precision="bf16-mixed",
)

_SMALL_ROOMS = TrainConfig(
    data=DataConfig(num_rooms=20_000, num_views=5, height=192, width=256, replay=6, shelf=12),
    steps=3000,
    sizes=((144, 192), (144, 192), (192, 256)),
    precision="bf16-mixed",
)

_LARGE_ROOMS = TrainConfig(
    data=DataConfig(
        num_rooms=20_000, seed=30_000, num_views=7, height=288, width=384, replay=4, shelf=12
    ),
    steps=2500,
    sizes=((192, 256), (240, 320), (288, 384)),
    batch_size=4,
    learning_rate=8e-4,
    max_views=7,
    num_keypoints=512,
    seed=1,
    precision="bf16-mixed",
)

RECIPES: dict[RecipeName, Recipe] = {
    # Small images teach what a match is for half of the work; large ones are what it is for.
    "night": Recipe((Part("1-small-rooms", _SMALL_ROOMS), Part("2-large-rooms", _LARGE_ROOMS))),
    "hour": Recipe((Part("1-rooms", _EVERYTHING_AT_ONCE),)),
}
"""For two CPU cores, and for a GPU with a dozen cores or more that render for it."""
