"""Rooms are scored by whatever makes depth: networks, settings and baselines."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from run_command import Run, assert_one_line

from deltas_geom import PosedViews, project
from deltas_nets.errors import UserError
from deltas_nets.evaluate.room_scores import room_in_files, score_rooms
from deltas_nets.evaluate.rooms import EVALUATION_SEEDS, held_out_rooms, predict_room
from deltas_nets.predict.depth_map import DepthMap, PredictConfig, Wanted
from deltas_nets.predict.ours import DeltasPredictor
from deltas_nets.rooms import render_room
from deltas_nets.weights_file import load_model

SIZE = (48, 64)
ON_ROOMS = ("--rooms", 1, "--views", 2, "--work-size", *SIZE)


def test_a_room_loses_nothing_in_files(tmp_path: Path) -> None:
    room = render_room(7, num_views=3, image_size=SIZE)
    capture = room_in_files(room, tmp_path / "room")
    frames = [capture.frame(id) for id in ("key", "1", "2")]
    for view, frame in enumerate(frames):
        assert np.array_equal(frame.read_image(), room.images[view].permute(1, 2, 0).numpy())
        assert np.array_equal(frame.read_depth(), room.depth[view].numpy())
    K, poses = (
        torch.from_numpy(np.stack([getattr(frame, part) for frame in frames]))
        for part in ("K", "cam_from_world")
    )
    point = torch.tensor([[0.1, -0.2, 2.0]]).double()  # m, of the key camera
    in_room = torch.linalg.inv(room.views.cam_from_world[0].double())
    there = project(
        PosedViews(*(part.double() for part in room.views)),
        point @ in_room[:3, :3].T + in_room[:3, 3],
    )
    found = project(PosedViews(K, poses), point)
    assert (found.pixels - there.pixels).abs().max() < 1e-4  # px


def test_scores_are_those_of_the_network_s_own_map() -> None:
    model, config = load_model(), PredictConfig(work_size=SIZE)
    room = held_out_rooms(1, EVALUATION_SEEDS, image_size=SIZE)[0]
    depth = predict_room(model, room, config.depth_range).depth[0]
    truth = room.depth[0]
    used = (truth >= 0.5) & (truth <= 10)
    expected = float(((depth - truth).abs() / truth)[used].mean())
    found = score_rooms(
        DeltasPredictor(model), held_out_rooms(1, EVALUATION_SEEDS, image_size=SIZE), config
    )
    assert found.frames["0"] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("weights", ["plane-sweep", "true-points", "no-points"])
def test_rooms_take_baselines(weights: str, run: Run, tmp_path: Path) -> None:
    done = run("evaluate", *ON_ROOMS, "--weights", weights, "--json", tmp_path / "scores.json")
    assert done.code == 0, done.err
    said = json.loads((tmp_path / "scores.json").read_text())
    assert said["metrics"]["dense"]["coverage"] == 1
    assert list(said["abs_rel_by_frame"]) == ["0"]
    assert ("sparse points" in said["metrics"]) == (weights != "no-points")
    record = said["weights"][weights]
    assert record["name"] == weights
    assert ("densifier_sha256" in record) == (weights != "plane-sweep")
    assert "sha256" not in record  # one file makes several baselines, whose rows differ


def test_settings_of_the_supplement_hold_on_rooms(run: Run, tmp_path: Path) -> None:
    scores: dict[int, dict[str, Any]] = {}
    for count in (0, 64):
        file = tmp_path / f"{count}.json"
        assert run("evaluate", *ON_ROOMS, "--num-points", count, "--json", file).code == 0
        scores[count] = json.loads(file.read_text())["metrics"]
    assert "sparse points" in scores[64]
    assert "sparse points" not in scores[0]


class Failing(DeltasPredictor):
    """Makes no map of the rooms of some numbers."""

    rooms: tuple[str, ...] = ()

    def depth_map(self, wanted: Wanted) -> DepthMap:
        file = wanted.anchor.image_path
        if file.parent.parent.name in self.rooms:
            raise UserError("no map", file, "try another")
        return super().depth_map(wanted)


def test_a_room_that_fails_is_named_by_its_number() -> None:
    network, config = Failing(load_model()), PredictConfig(work_size=SIZE)
    rooms = held_out_rooms(2, EVALUATION_SEEDS, num_views=2, image_size=SIZE)
    network.rooms = ("1",)
    found = score_rooms(network, rooms, config)
    assert found.failed == {"1": "no map, room 1: try another"}
    assert list(found.frames) == ["0"]
    network.rooms = ("0", "1")
    with pytest.raises(UserError, match="no map, room 0"):
        score_rooms(network, rooms, config)


def test_rooms_are_all_of_them_or_the_first(run: Run) -> None:
    assert_one_line(run("evaluate", *ON_ROOMS, "--sets", 1), "rooms have none, --sets")
    assert_one_line(
        run("evaluate", *ON_ROOMS, "--depth-range", 90, 95), "no room has true depth in range"
    )
