"""Rooms kept in memory, so that each can be used in several steps.

Rendering a room takes longer than learning from it where a GPU learns. Every place of a step has
a shelf of the last few rooms that it was given and takes one of them at random, to be seen from
another anchor, with other sources, in another light. Since shelves belong to places, what a step
sees does not depend on which process holds which places.
"""

import numpy as np
import torch
from torch import Tensor

from deltas_nets.captures.posed_images import PosedImages


def places_with_new_rooms(step: int, places: range, replay: int) -> list[int]:
    """The places of a step that get a new room; each does once in ``replay`` steps."""
    return [place for place in places if (step + place) % replay == 0]


class Shelves:
    """A shelf of rooms for every place that this process holds.

    Args:
        places: of a step, those of this process.
        depth: rooms on a shelf; the oldest makes room for a new one.
        replay: steps from one new room of a place to its next.
        seed: of what is taken.
    """

    def __init__(self, places: range, depth: int, replay: int, *, seed: int) -> None:
        self.places = places
        self.depth = depth
        self.replay = replay
        self.seed = seed
        self._rooms: PosedImages | None = None

    def first_step(self, step: int) -> int:
        """The step from which new rooms have to be put for the shelves to be as at ``step``.

        Negative before there is a whole shelf's worth of steps: step 0 finds one room on each.
        """
        return max(step + 1 - self.depth * self.replay, 1 - self.replay)

    def put(self, rooms: PosedImages, step: int) -> None:
        """Take in the new rooms of a step, those of ``places_with_new_rooms`` in order."""
        new = places_with_new_rooms(step, self.places, self.replay)
        shelves = [place - self.places.start for place in new]
        slots = [(self._given(place, step) - 1) % self.depth for place in new]
        if self._rooms is None:
            self._rooms = rooms.map(self._empty)
        for place, slot, *fresh in zip(shelves, slots, *rooms.tensors(), strict=True):
            for kept, room in zip(self._rooms.tensors(), fresh, strict=True):
                kept[place, slot].copy_(room)

    def take(self, step: int) -> PosedImages:
        """One room from each shelf, ``(B, ...)``."""
        assert self._rooms is not None, "put comes first"
        random = np.random.default_rng((self.seed, step))
        # Drawn for all places up to the last: a place's draw does not depend on who else is here.
        draws = random.random(self.places.stop)[self.places.start :]
        slots = [
            int(draw * min(self._given(place, step), self.depth))
            for draw, place in zip(draws, self.places, strict=True)
        ]
        # Row by row, without an index on the device to wait for.
        return self._rooms.map(
            lambda kept: torch.stack([row[slot] for row, slot in zip(kept, slots, strict=True)])
        )

    def _given(self, place: int, step: int) -> int:
        """New rooms that a place has got up to a step and in it; 1 in step 0."""
        first = (-1 - place) % self.replay + 1 - self.replay
        return (step - first) // self.replay + 1

    def _empty(self, rooms: Tensor) -> Tensor:
        return rooms.new_zeros(len(self.places), self.depth, *rooms.shape[1:])
