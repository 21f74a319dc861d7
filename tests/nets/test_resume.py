"""Which options a resumed run may be given anew."""

from dataclasses import replace
from pathlib import Path

import pytest
from run_fit import CONFIG

from deltas_nets.config import TRAIN_CONFIGS, MatcherConfig, TrainConfig, to_dict
from deltas_nets.errors import UserError
from deltas_nets.outputs.atomic_files import write_json
from deltas_nets.train.resume import OF_THE_MACHINE, check_continues, resumed_config

USUAL = TRAIN_CONFIGS["deltas-small"]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A run of `CONFIG` on four GPUs."""
    write_json(tmp_path / "config.json", to_dict(replace(CONFIG, devices=4)))
    return tmp_path


def asked(**changes: object) -> TrainConfig:
    return replace(USUAL, **changes)  # type: ignore[arg-type]


def test_without_options_a_run_goes_on_as_it_was(folder: Path) -> None:
    assert resumed_config(folder, USUAL, USUAL) == replace(CONFIG, devices=4)


def test_what_is_the_machines_may_be_given_anew(folder: Path) -> None:
    data = replace(USUAL.data, cache="elsewhere", workers=7)
    config = resumed_config(folder, asked(devices=2, num_nodes=3, data=data), USUAL)
    expected = replace(CONFIG.data, cache="elsewhere", workers=7)
    assert config == replace(CONFIG, devices=2, num_nodes=3, data=expected)
    check_continues(folder, config)


def test_the_same_command_with_resume_is_accepted(folder: Path) -> None:
    given = asked(steps=CONFIG.steps, batch_size=CONFIG.batch_size, sizes=CONFIG.sizes)
    assert resumed_config(folder, given, USUAL) == replace(CONFIG, devices=4)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"steps": 9}, "steps 8, not 9"),
        ({"precision": "bf16-mixed"}, "precision 32-true, not bf16-mixed"),
        ({"teacher": "disk"}, "teacher None, not disk"),
        ({"data": replace(USUAL.data, num_rooms=7)}, "data.num_rooms 4, not 7"),
        (
            {"network": replace(USUAL.network, matcher=MatcherConfig(num_samples=48))},
            "network.matcher.num_samples 32, not 48",
        ),
    ],
)
def test_what_changes_the_result_is_named(
    folder: Path, changes: dict[str, object], message: str
) -> None:
    with pytest.raises(UserError) as error:
        resumed_config(folder, asked(**changes), USUAL)
    assert f"has {message}" in error.value.what and error.value.where == folder / "config.json"
    assert error.value.remedy.startswith("leave ")


def test_no_other_config_continues_a_run(folder: Path) -> None:
    check_continues(folder, CONFIG)  # on one device
    with pytest.raises(UserError, match="seed 0, not 1"):
        check_continues(folder, replace(CONFIG, seed=1))
    with pytest.raises(UserError, match="nothing to resume"):
        check_continues(folder / "none", CONFIG)


def test_every_field_of_the_machine_exists() -> None:
    for name in OF_THE_MACHINE:
        value: object = USUAL
        for part in name.split("."):
            value = getattr(value, part)
