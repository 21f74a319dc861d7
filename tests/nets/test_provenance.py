"""What weights say of where they come from, after any number of trainings."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from run_command import Run, assert_one_line
from run_fit import CONFIG, train
from safetensors.torch import save_file

from deltas_nets.config import DataConfig, TrainConfig
from deltas_nets.config.scannet import ScanNetConfig
from deltas_nets.errors import UserError
from deltas_nets.network.deltas import Deltas
from deltas_nets.network.lite.efficientnet import EfficientNetLite0
from deltas_nets.train import start as start_module
from deltas_nets.train.fit import Start
from deltas_nets.train.provenance import OURS, Provenance, record_of
from deltas_nets.weights_file import read_metadata, save_weights

SCANNET = replace(CONFIG, data=DataConfig(source="scannet", scannet=ScanNetConfig(root="x")))
TERMS = "trained on ScanNet, whose terms of use apply"
DISTILLED = {
    "data": "procedural rooms 60000..80000",
    "licence": OURS,
    "origin": "encoder from EfficientNet-Lite0 (Apache-2.0)",
    "detector_teacher": "superpoint",
    "detector_teacher_licence": "non-commercial research",
    "detector_loss": "0.5",
    "calibration": "rooms",
}


def after(*configs: TrainConfig) -> dict[str, str]:
    """The record of weights that were trained by one config after the other."""
    record = record_of(configs[0], Provenance("random weights"))
    for config in configs[1:]:
        record = record_of(config, Provenance(record["origin"], record))
    return record


def test_terms_of_data_outlast_any_training_on_rooms() -> None:
    assert after(CONFIG)["licence"] == OURS
    rooms = "procedural rooms 1000..1004"
    for configs in ((SCANNET, CONFIG), (CONFIG, SCANNET), (SCANNET, CONFIG, CONFIG)):
        assert after(*configs)["licence"] == TERMS
    assert after(SCANNET, CONFIG)["data"] == f"ScanNet, scenes of train; {rooms}"
    assert after(CONFIG, CONFIG)["data"] == rooms


def test_what_weights_without_a_record_learned_from_is_unknown() -> None:
    record = record_of(CONFIG, Provenance("unknown weights", {}))
    assert record["licence"] == "unknown licence"
    assert record["data"].startswith("unknown data; procedural rooms")


def test_a_teacher_of_before_is_named_with_its_licence() -> None:
    frozen = replace(CONFIG, freeze=("detector",))
    record = record_of(frozen, Provenance("o", DISTILLED))
    assert (record["detector_teacher"], record["detector_loss"]) == ("superpoint", "0.5")
    assert "calibration" not in record  # it was fitted to other weights
    learned_on = record_of(CONFIG, Provenance("o", DISTILLED))
    assert learned_on["detector_teacher_licence"] == "non-commercial research"
    assert "detector_loss" not in learned_on
    taught = record_of(replace(CONFIG, teacher="aliked"), Provenance("o", DISTILLED))
    assert taught["detector_teacher"] == "aliked"
    assert taught["detector_teacher_licence"] == "non-commercial research; BSD-3-Clause"


def test_a_run_writes_the_record_of_its_init_also_after_it_was_resumed(tmp_path: Path) -> None:
    torch.manual_seed(0)
    file = tmp_path / "before.safetensors"
    save_weights(file, Deltas(CONFIG.network), DISTILLED | {"licence": TERMS})
    config = replace(CONFIG, steps=2)
    train(tmp_path / "run", config, Start(init=file), stop=1)
    for start in (None, Start(resume=True)):
        if start is not None:
            train(tmp_path / "run", config, start)
        record = read_metadata(tmp_path / "run" / "weights.safetensors")
        assert record["licence"] == TERMS
        assert record["data"] == "procedural rooms 60000..80000; procedural rooms 1000..1004"
        assert record["detector_teacher"] == "superpoint"
        assert record["origin"] == DISTILLED["origin"]


def test_a_run_goes_on_with_the_files_that_it_began_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(start_module, "load_teacher", lambda *_: torch.nn.Conv2d(3, 1, 1))
    for name in ("teacher", "other"):
        save_file({name: torch.zeros(1)}, tmp_path / f"{name}.safetensors")
    teacher, other = tmp_path / "teacher.safetensors", tmp_path / "other.safetensors"
    save_weights(tmp_path / "init.safetensors", Deltas(CONFIG.network), {})
    init, run = tmp_path / "init.safetensors", tmp_path / "run"
    config = replace(CONFIG, teacher="disk")
    train(run, config, Start(init=init, teacher=teacher), stop=1)
    train(run, config, Start(resume=True, init=init, teacher=teacher), stop=1)
    for changed, option in (
        (Start(resume=True, teacher=other), "--teacher-weights"),
        (Start(resume=True, init=other, teacher=teacher), "--init"),
        (Start(resume=True, encoder=other, teacher=teacher), "--encoder"),
        (Start(resume=True, step=2, teacher=teacher), "--start-step"),
    ):
        with pytest.raises(UserError, match=f"did not begin with this, {option}: "):
            train(run, config, changed, stop=1)


def test_a_run_of_a_pretrained_encoder_does_not_go_on_as_one_of_random_weights(
    tmp_path: Path, run: Run
) -> None:
    encoder, out = tmp_path / "lite0.pth", tmp_path / "run"
    torch.save(EfficientNetLite0().state_dict(), encoder)
    train(out, CONFIG, Start(encoder), stop=1)
    told = run("train", "--out", out, "--resume", "--encoder", "none")
    assert_one_line(told, "did not begin with this", "--encoder", "leave that option out")
    random = tmp_path / "random"
    train(random, CONFIG, Start(random_encoder=True), stop=1)
    train(random, CONFIG, Start(resume=True, random_encoder=True), stop=1)
