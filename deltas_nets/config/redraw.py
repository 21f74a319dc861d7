"""What training the stage that redraws depends on."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from deltas_nets.config.checks import check_at_least, check_positive, check_seed
from deltas_nets.config.training import DataConfig, TrainConfig


@dataclass(frozen=True)
class RedrawConfig:
    """Train a second densifier to draw maps anew that several frames agreed on."""

    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """Weights file to write, .safetensors: the network with its new stage."""
    init: str = "deltas-small"
    """The network that it is for, and whose own densifier or stage that redraws it starts from: a
    shipped one, or a weights file of `deltas train`."""
    steps: int = 1500
    """Optimiser steps."""
    batch_size: int = 4
    """Rooms per step; each is seen in four steps or so."""
    learning_rate: float = 3e-4
    """Peak; it falls to a hundredth along half a cosine."""
    sizes: tuple[tuple[int, int], ...] = ((240, 320), (240, 320), (240, 320), (288, 384))
    """(height, width) of the images of a step, drawn at random."""
    num_views: int = 3
    """Views of the maps that err as those do which are to be drawn anew."""
    num_keypoints: int = 640
    """Points of these maps."""
    num_rooms: int = 5000
    """Rooms in an epoch."""
    first_room: int = 300_000
    """Seed of the first room."""
    save_every: int = 100
    """Steps after which --out is written anew, with what is there by then."""
    workers: int = 1
    """Processes that render."""
    cache: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder that keeps rendered rooms; without it they are rendered."""
    log: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Gets a line of JSON for every 20 steps."""
    seed: int = 0
    """Of everything random."""

    def __post_init__(self) -> None:
        check_at_least(1, self, "steps", "save_every")
        check_at_least(0, self, "workers")
        check_at_least(2, self, "num_views")
        check_at_least(8, self, "num_keypoints")
        check_positive(self, "learning_rate")
        check_seed(self)
        if self.batch_size < REPLAY or self.batch_size % REPLAY:
            raise ValueError(f"batch_size must be a multiple of {REPLAY}, got {self.batch_size}")
        for size in self.sizes:
            if min(size) < 32:
                raise ValueError(f"sizes must be HEIGHT WIDTH of 32 or more, got {size}")
        if self.first_room < VALIDATED:
            what = f"first_room must be {VALIDATED} or more, as no training sees those below"
            raise ValueError(f"{what}; got {self.first_room}")
        self.of_rooms()

    def of_rooms(self) -> TrainConfig:
        """How rooms are rendered and seen."""
        data = DataConfig(
            num_rooms=self.num_rooms,
            seed=self.first_room,
            num_views=self.num_views + 2,
            height=max(height for height, _ in self.sizes),
            width=max(width for _, width in self.sizes),
            cache=None if self.cache is None else str(self.cache),
            workers=self.workers,
            replay=REPLAY,
            shelf=10,
        )
        return TrainConfig(
            data=data,
            steps=self.steps,
            sizes=self.sizes,
            batch_size=self.batch_size,
            min_views=self.num_views,
            max_views=self.num_views,
            seed=self.seed,
        )


REPLAY = 4
"""Steps in which a rendered room is seen."""
VALIDATED = 1000
"""Seeds below are those of rooms that are measured on."""
