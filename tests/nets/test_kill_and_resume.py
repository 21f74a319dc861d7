"""SIGKILL in the middle of a checkpoint costs the steps since the last one, and nothing else."""

import json
import os
import signal
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from run_fit import CONFIG as CONFIG_OF_FOUR
from run_fit import assert_same_state, finish, launch, logged, read_checkpoint, train

from deltas_nets.train import fit as fit_module
from deltas_nets.train.fit import Start
from deltas_nets.train.log import LOG

HALF_WRITTEN = ".checkpoint.pt.*.deltas-tmp"
CONFIG = replace(CONFIG_OF_FOUR, batch_size=2, steps=7)


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("unbroken")
    train(folder, CONFIG, Start(), validate_every=3)
    return folder


def test_a_run_killed_while_it_writes_a_checkpoint_ends_as_an_unbroken_one(
    tmp_path: Path, unbroken: Path
) -> None:
    killed = tmp_path / "killed"
    process = launch(killed, CONFIG, "half=6")
    deadline = time.monotonic() + 120
    while not (killed / "writing").exists():
        assert process.poll() is None and time.monotonic() < deadline, process.communicate()[0]
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()

    # It had reached step 6; what is whole is the checkpoint of step 3.
    (half,) = killed.glob(HALF_WRITTEN)
    assert half.stat().st_size > 1_000_000
    assert read_checkpoint(killed)["step"] == 3
    assert [entry["step"] for entry in logged(killed)] == [1, 2, 3, 4, 5, 6]

    train(killed, CONFIG, Start(resume=True))
    assert_same_state(killed, unbroken)
    assert logged(killed) == logged(unbroken)
    assert not list(killed.glob(".*"))


def test_a_signal_to_the_whole_group_ends_it_between_two_steps(
    tmp_path: Path, unbroken: Path
) -> None:
    """A terminal's Ctrl-C, `timeout` and job schedulers reach the processes that render, too."""
    stopped = tmp_path / "stopped"
    ahead = replace(CONFIG, data=replace(CONFIG.data, workers=2))
    said = finish(launch(stopped, ahead, "stop-all"), code=-signal.SIGINT)
    assert "KeyboardInterrupt" in said
    assert "exited unexpectedly" not in said
    assert said.count("stopping after this step") == 1
    assert read_checkpoint(stopped)["step"] == 2
    train(stopped, CONFIG, Start(resume=True))
    assert_same_state(stopped, unbroken)


@pytest.mark.parametrize("step", [3, 7], ids=["on the way", "at the end"])
def test_a_stop_does_not_wait_for_a_validation_which_is_made_up_for(
    tmp_path: Path, unbroken: Path, monkeypatch: pytest.MonkeyPatch, step: int
) -> None:
    """It takes minutes; what was trained by then is kept."""
    stopped, validate = tmp_path / "stopped", fit_module.metrics_of
    calls: list[int] = []

    def interrupted(*arguments: Any) -> dict[str, float]:
        calls.append(3 * len(calls) + 3)
        if min(calls[-1], CONFIG.steps) == step:
            signal.raise_signal(signal.SIGTERM)
            pytest.fail("it went on")
        return validate(*arguments)

    monkeypatch.setattr(fit_module, "metrics_of", interrupted)
    with pytest.raises(KeyboardInterrupt):
        train(stopped, CONFIG, Start(), validate_every=3)
    assert read_checkpoint(stopped)["step"] == step
    monkeypatch.undo()
    train(stopped, CONFIG, Start(resume=True), validate_every=3)
    assert_same_state(stopped, unbroken)
    assert logged(stopped) == logged(unbroken)
    assert validations(stopped) == validations(unbroken) != []


def validations(folder: Path) -> list[tuple[int, dict[str, float]]]:
    lines = (folder / LOG).read_text().splitlines()
    entries = [json.loads(line) for line in lines]
    return [(entry["step"], entry["validation"]) for entry in entries if "validation" in entry]
