"""What training the stage that redraws depends on."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from deltas_nets.config.checks import check_at_least, check_positive, check_seed, check_unseen


@dataclass(frozen=True)
class RedrawConfig:
    """Train a second densifier to draw maps anew that several frames agreed on."""

    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """Weights file to write, .safetensors: the network with its new stage."""
    init: str = "deltas-small"
    """The network that it is for, and whose own densifier or stage that redraws it starts from: a
    shipped one, or a weights file of `deltas train`."""
    steps: int = 600
    """Optimiser steps."""
    batch_size: int = 4
    """Views per step, of as many rooms."""
    learning_rate: float = 4e-4
    """Peak; it falls to a hundredth along half a cosine."""
    sizes: tuple[tuple[int, int], ...] = ((288, 384), (240, 320))
    """(height, width) of the images of a step, drawn at random; rooms have the largest of them."""
    num_rooms: int = 300
    """Rooms, each made once: twelve seconds of a processor."""
    num_views: int = 10
    """Views of a room, whose maps hear each other."""
    num_sources: int = 2
    """Other views that a map is made from."""
    close_ups: float = 0.3
    """Share of the rooms that are desks, shelves and floors from near by."""
    first_room: int = 300_000
    """Seed of the first room."""
    save_every: int = 100
    """Steps after which --out is written anew, with what is there by then."""
    workers: int = 1
    """Processes that make rooms; 0 does it in the training process."""
    cache: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder that keeps the rooms and the network's maps of them, 15 MB each, for other trainings
    of the same network; without it they are gone afterwards."""
    log: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Gets a line of JSON for every 20 steps."""
    seed: int = 0
    """Of everything random."""

    def __post_init__(self) -> None:
        check_at_least(1, self, "steps", "save_every", "batch_size", "num_rooms", "num_sources")
        check_at_least(0, self, "workers")
        check_positive(self, "learning_rate")
        check_seed(self)
        if not self.num_sources < self.num_views <= MOST_VIEWS:
            raise ValueError(
                f"num_views must be above num_sources and at most {MOST_VIEWS}, got "
                f"{self.num_views} and {self.num_sources}"
            )
        if not 0 <= self.close_ups <= 1:
            raise ValueError(f"close_ups must be within [0, 1], got {self.close_ups}")
        if not self.sizes or min(map(min, self.sizes)) < 32:
            raise ValueError(f"sizes must be HEIGHT WIDTH of 32 or more, got {self.sizes}")
        check_unseen(self, "first_room")


MOST_VIEWS = 12
"""Of a room."""
