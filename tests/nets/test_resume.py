"""Which options a resumed run may be given anew."""

from dataclasses import replace
from pathlib import Path

import pytest
from run_command import Run, assert_one_line
from run_fit import CONFIG

from deltas_nets import cli
from deltas_nets.commands.command_line import parse
from deltas_nets.commands.train import Train
from deltas_nets.config import TrainConfig, to_dict
from deltas_nets.config.scannet import ScanNetConfig
from deltas_nets.errors import UserError
from deltas_nets.outputs.atomic_files import write_json
from deltas_nets.train.resume import OF_THE_MACHINE, check_continues

TINY = replace(CONFIG, devices=4, seed=1, data=replace(CONFIG.data, workers=3))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A run on four GPUs."""
    write_json(tmp_path / "config.json", to_dict(TINY))
    return tmp_path


def asked(folder: Path, *options: object) -> TrainConfig:
    """What a run would go on with."""
    words = ["train", "--out", str(folder), "--resume", *map(str, options)]
    command = parse(words, cli.COMMANDS)
    assert isinstance(command, Train)
    check_continues(folder, command.config)
    return command.config


def test_without_options_a_run_goes_on_as_it_was(folder: Path) -> None:
    assert asked(folder) == TINY
    words = ["train", f"--out={folder}", "--resume"]
    assert vars(parse(words, cli.COMMANDS))["config"] == TINY


def test_what_is_the_machines_may_be_given_anew(folder: Path) -> None:
    options = ["--devices", 2, "--num-nodes", 3, "--data.cache", "elsewhere", "--data.workers", 7]
    data = replace(TINY.data, cache="elsewhere", workers=7)
    assert asked(folder, *options) == replace(TINY, devices=2, num_nodes=3, data=data)


def test_what_is_usual_is_an_answer_like_others(folder: Path) -> None:
    """The run has four devices and three workers; the command's usual is one of each."""
    config = asked(folder, "--devices", 1, "--data.workers", 1)
    assert (config.devices, config.data.workers) == (1, 1)


def test_scenes_may_have_moved(folder: Path) -> None:
    scannet = ScanNetConfig(root="before", gap=4)
    config = replace(TINY, data=replace(TINY.data, source="scannet", scannet=scannet))
    write_json(folder / "config.json", to_dict(config))
    moved = asked(folder, "--root", "after").data.scannet
    assert moved == replace(scannet, root="after")


def test_the_same_command_with_resume_is_accepted(folder: Path) -> None:
    given = ["--steps", TINY.steps, "--batch-size", TINY.batch_size, "--sizes", 48, 64]
    assert asked(folder, *given, "--config", "deltas-small") == TINY


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--steps", 9], "steps 8, not 9"),
        (["--seed", 0], "seed 1, not 0"),
        (["--precision", "bf16-mixed"], "precision 32-true, not bf16-mixed"),
        (["--teacher", "disk"], "teacher None, not disk"),
        (["--data.num-rooms", 7], "data.num_rooms 4, not 7"),
        (["--num-keypoints", 320], "num_keypoints 48, not 320"),
        (["--network.matcher.num-samples", 48], "network.matcher.num_samples 32, not 48"),
    ],
)
def test_what_changes_the_result_is_named(
    folder: Path, options: list[object], message: str
) -> None:
    with pytest.raises(UserError) as error:
        asked(folder, *options)
    assert f"has {message}" in error.value.what and error.value.where == folder / "config.json"
    assert error.value.remedy.startswith("leave ")


def test_the_preset_of_another_network_is_refused(folder: Path, run: Run) -> None:
    network = replace(TINY.network, name="deltas-vgg9")
    write_json(folder / "config.json", to_dict(replace(TINY, network=network)))
    for preset in ("deltas-small", "deltas-resnet50"):
        told = run("train", "--out", folder, "--resume", "--config", preset)
        assert_one_line(told, "is of deltas-vgg9", f"--config {preset}", "leave it out")
    assert asked(folder, "--config", "deltas-vgg9").network == network


@pytest.mark.parametrize("content", ["[1]", "7", "{", '{"new": 1}', None])
def test_a_config_that_is_none_is_refused_in_a_line(
    folder: Path, run: Run, content: str | None
) -> None:
    file = folder / "config.json"
    file.unlink()
    file.mkdir() if content is None else file.write_text(content)
    assert_one_line(run("train", "--out", folder, "--resume"), "config is not readable")


@pytest.mark.parametrize("content", ["{", None])
def test_a_run_without_its_config_leaves_its_weights(
    folder: Path, run: Run, content: str | None
) -> None:
    (folder / "weights.safetensors").touch()
    (folder / "config.json").unlink()
    if content is not None:
        (folder / "config.json").write_text(content)
    remedy = f"config.json: go on from its weights in a new folder: --init {folder}/weights."
    assert_one_line(run("train", "--out", folder, "--resume"), remedy)


def test_no_other_config_continues_a_run(folder: Path) -> None:
    check_continues(folder, replace(TINY, devices=1))
    with pytest.raises(UserError, match="seed 1, not 0"):
        check_continues(folder, CONFIG)
    with pytest.raises(UserError, match="nothing to resume"):
        check_continues(folder / "none", CONFIG)


def test_every_field_of_the_machine_exists() -> None:
    for name in OF_THE_MACHINE:
        value: object = TINY
        for part in name.split("."):
            value = getattr(value, part)
