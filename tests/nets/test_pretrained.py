"""Weights files: round trip, shipped weights, clear errors."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor

from deltas_nets import load_model
from deltas_nets.config import DetectorConfig, MatcherConfig, NetworkConfig, to_dict
from deltas_nets.errors import UserError
from deltas_nets.network.deltas import Deltas
from deltas_nets.weights_file import (
    load_weights,
    read_metadata,
    save_weights,
    start_from_weights,
    weights_file,
)


def test_weights_and_config_survive_a_file(tmp_path: Path) -> None:
    torch.manual_seed(1)
    model = Deltas(NetworkConfig(name="mine", detector=DetectorConfig(num_keypoints=32)))
    save_weights(tmp_path / "w.safetensors", model, {"step": "5"})
    loaded = load_model(tmp_path / "w.safetensors")
    assert loaded.config == model.config
    assert not loaded.training
    for name, tensor in model.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], tensor), name
    assert read_metadata(tmp_path / "w.safetensors")["step"] == "5"


def test_shipped_weights_are_small_and_say_where_they_come_from() -> None:
    file = weights_file("deltas-small")
    assert file.stat().st_size <= 12 * 2**20
    metadata = read_metadata(file)
    assert metadata["licence"] == "Apache-2.0"
    assert "EfficientNet-Lite0 (Apache-2.0)" in metadata["origin"]
    assert "rooms" in metadata["data"]
    assert int(metadata["step"]) > 0
    assert json.loads(metadata["network"])["name"] == "deltas-small"


def test_other_files_are_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(
        UserError, match=r"no such weights, nope: name a .safetensors file or deltas-small$"
    ):
        load_model("nope")
    with pytest.raises(UserError, match=r"file or deltas-small: plane-sweep has none"):
        load_model("plane-sweep")
    wrong = tmp_path / "wrong.safetensors"
    wrong.write_bytes(b"not one")
    with pytest.raises(UserError, match=r"not a safetensors file .*wrong.safetensors"):
        load_model(wrong)
    with pytest.raises(UserError, match=r"no such weights, xxx"):
        load_model("x" * 300)
    for config in ("[]", '{"matcher": []}', "[" * 100_000):
        save_file({"a": torch.zeros(1)}, wrong, {"network": config})
        with pytest.raises(UserError, match="weights of another version"):
            load_model(wrong)
    small = Deltas(NetworkConfig(descriptor_dim=16))
    save_weights(tmp_path / "small.safetensors", small, {})
    with pytest.raises(UserError, match=r"do not fit the network .*small.safetensors"):
        load_weights(Deltas(NetworkConfig()), tmp_path / "small.safetensors")


def test_training_goes_on_from_weights_of_before_the_network_grew(tmp_path: Path) -> None:
    torch.manual_seed(1)
    before = Deltas(NetworkConfig(matcher=MatcherConfig(context_rounds=2)))
    save_weights(tmp_path / "before.safetensors", before, {})
    grown = Deltas(NetworkConfig())
    fresh = {name: tensor.clone() for name, tensor in grown.state_dict().items()}
    new = start_from_weights(grown, tmp_path / "before.safetensors")
    assert new
    assert all(name.startswith("matcher.context.rounds.2.") for name in new)
    for name, tensor in grown.state_dict().items():
        expected = fresh[name] if name in new else before.state_dict()[name]
        assert torch.equal(tensor, expected), name


def test_weights_of_something_else_are_no_start(tmp_path: Path) -> None:
    model = Deltas(NetworkConfig())
    save_file({"judge.correction.0.weight": torch.zeros(32, 78)}, tmp_path / "few.safetensors")
    with pytest.raises(UserError, match=r"are lacking.*few.safetensors"):
        start_from_weights(model, tmp_path / "few.safetensors")
    more = dict(model.state_dict()) | {"other": torch.zeros(1)}
    save_file(more, tmp_path / "more.safetensors")
    with pytest.raises(UserError, match=r"do not fit the network .*more.safetensors"):
        start_from_weights(model, tmp_path / "more.safetensors")


CHANGED = "encoder._conv_stem.weight"


def rewritten(file: Path, change: Callable[[Tensor], Tensor]) -> Path:
    """The weights of a new network, with one of them changed."""
    model = Deltas(NetworkConfig())
    state = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    state[CHANGED] = change(state[CHANGED])
    record = {"network": json.dumps(to_dict(model.config))}
    save_file(state, file, record)
    return file


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_not_finite_are_refused(tmp_path: Path, value: float) -> None:
    file = rewritten(tmp_path / "w.safetensors", lambda weight: torch.full_like(weight, value))
    said = rf"not finite \({CHANGED}\), .*w.safetensors"
    with pytest.raises(UserError, match=said):
        load_model(file)
    with pytest.raises(UserError, match=said):
        start_from_weights(Deltas(NetworkConfig()), file)


def test_whole_numbers_are_no_weights(tmp_path: Path) -> None:
    file = rewritten(tmp_path / "w.safetensors", lambda weight: weight.to(torch.int8))
    with pytest.raises(UserError, match=rf"{CHANGED} holds whole numbers .*w.safetensors"):
        load_model(file)
    half = rewritten(tmp_path / "half.safetensors", lambda weight: weight.half())
    assert load_model(half).encoder.state_dict()["_conv_stem.weight"].dtype == torch.float32


def test_a_folder_of_a_run_is_told_from_its_weights(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"a folder, not weights, .*: name a .safetensors file"):
        load_model(tmp_path)
    (tmp_path / "weights.safetensors").touch()
    with pytest.raises(UserError, match=r"a folder, not weights, .*: name \S+/weights.safetensors"):
        load_model(tmp_path)


def test_hundreds_of_missing_weights_are_told_in_a_line(tmp_path: Path) -> None:
    file = tmp_path / "w.safetensors"
    record = {"network": json.dumps(to_dict(NetworkConfig()))}
    save_file({"other": torch.zeros(1)}, file, record)
    with pytest.raises(UserError, match="do not fit the network") as caught:
        load_model(file)
    assert len(caught.value.what) < 200
