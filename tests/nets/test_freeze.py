"""Stages that a run leaves as they are."""

from dataclasses import replace
from pathlib import Path
from typing import get_args

import pytest
import torch
from run_fit import CONFIG, read_checkpoint, train
from torch import nn

from deltas_nets.config import CONFIGS, TrainConfig
from deltas_nets.config.training import Stage
from deltas_nets.errors import UserError
from deltas_nets.network.deltas import Deltas
from deltas_nets.train.fit import Start
from deltas_nets.train.freeze import frozen_stages

STAGES: tuple[Stage, ...] = get_args(Stage)


def test_every_stage_can_be_named_and_no_other() -> None:
    children = {name for name, _ in Deltas(CONFIG.network).named_children()}
    assert children == set(STAGES)


def test_stages_that_a_network_lacks_are_passed_over() -> None:
    model = nn.ModuleDict({"encoder": nn.Linear(1, 1)})
    assert frozen_stages(model, replace(CONFIG, freeze=("encoder", "judge"))) == [model["encoder"]]
    assert CONFIGS["deltas-resnet50"].matcher.kind == "per_view"  # and has no judge


def test_something_is_left_that_learns(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="freeze must leave a stage that learns"):
        replace(CONFIG, freeze=STAGES)
    # The only stage left is one that the paper's networks lack.
    network = replace(CONFIG.network, matcher=replace(CONFIG.network.matcher, kind="per_view"))
    config = replace(CONFIG, network=network, freeze=tuple(s for s in STAGES if s != "judge"))
    with pytest.raises(UserError, match="no loss teaches what is not frozen, --freeze encoder"):
        train(tmp_path, config, Start())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("freeze", [("encoder", "detector"), ("matcher", "judge", "densifier")])
def test_frozen_stages_stay_and_the_others_learn(tmp_path: Path, freeze: tuple[Stage, ...]) -> None:
    config: TrainConfig = replace(CONFIG, steps=2, freeze=freeze)
    train(tmp_path, config, Start())
    torch.manual_seed(config.seed)
    before = Deltas(config.network).state_dict()
    moved = {
        name.partition(".")[0]
        for name, tensor in read_checkpoint(tmp_path)["model"].items()
        if not torch.equal(tensor, before[name])
    }
    assert moved == set(STAGES) - set(freeze)  # batch norm's statistics are among the tensors
