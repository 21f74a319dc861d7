"""Rooms rendered ahead are those of the data set, in its order, whatever becomes of who asks."""

import multiprocessing
import os
import time

import torch

from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.datasets.workers import rendered_ahead
from deltas_nets.evaluate.room_scores import score_rooms
from deltas_nets.evaluate.rooms import EVALUATION_SEEDS, held_out_rooms
from deltas_nets.predict.depth_map import PredictConfig
from deltas_nets.predict.predictor import load_predictor

SIZE = (48, 64)


class Slow(torch.utils.data.Dataset[PosedImages]):
    """Rooms of which the first takes longest; images name the process that made them."""

    def __getitem__(self, index: int) -> PosedImages:
        time.sleep(0.3 if index == 0 else 0.0)
        room = held_out_rooms(5, EVALUATION_SEEDS, num_views=2, image_size=SIZE)[index]
        return room._replace(depth=torch.tensor([index, os.getpid(), os.getpgrp()]))


def test_the_order_is_the_data_set_s_and_others_do_the_work() -> None:
    made = [room.depth.tolist() for room in rendered_ahead(Slow(), 4)]
    assert [index for index, _, _ in made] == [0, 1, 2, 3]
    for _, process, group in made:
        assert process != os.getpid(), "rendered by who asks"
        assert group != os.getpgrp(), "Ctrl-C would reach it first"


def test_who_stops_asking_leaves_no_process_behind() -> None:
    rooms = rendered_ahead(Slow(), 5)
    next(rooms)
    assert multiprocessing.active_children()
    rooms.close()  # type: ignore[attr-defined]
    assert not multiprocessing.active_children()


def test_scores_are_those_of_rooms_in_memory() -> None:
    network, config = load_predictor("deltas-small"), PredictConfig(work_size=SIZE)
    rooms = held_out_rooms(2, EVALUATION_SEEDS, num_views=2, image_size=SIZE)
    kept = [rooms[number] for number in range(2)]
    ahead = score_rooms(network, rooms, config)
    assert ahead.dense == score_rooms(network, kept, config).dense
