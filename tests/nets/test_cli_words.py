"""What the command says of wrong arguments: a line, whatever they are."""

from pathlib import Path

import pytest
from run_command import Run, assert_one_line

COMMANDS = (
    "demo",
    "depth",
    "evaluate",
    "train",
    "recipe",
    "distill",
    "calibrate",
    "export",
    "cost",
)


def test_without_arguments_the_help_is_shown(run: Run) -> None:
    shown = run()
    assert (shown.code, shown.err) == (0, "")
    assert all(command in shown.out for command in COMMANDS)
    assert shown.out == run("--help").out


@pytest.mark.parametrize("arguments", [["foo"], ["depth", "x", "--out", "y", "foo"], ["depth"]])
def test_no_words_are_doubled(run: Run, arguments: list[str]) -> None:
    told = run(*arguments)
    assert_one_line(told, "Missing from deltas depth" if arguments == ["depth"] else "options: foo")
    assert told.err.count("nrecognized") <= 1 and told.err.count("--help") == 1


def test_an_argument_that_does_not_parse_is_named(run: Run) -> None:
    assert_one_line(run("train", "--steps", "abc"), "deltas: Error parsing --steps: ", "'abc'")
    told = run("evaluate", "--rooms", 1, "--conditions", "foo")
    assert_one_line(told, "'foo' for argument '--conditions'", "deltas evaluate --help")


def test_a_capture_and_rooms_are_not_both_scored(run: Run) -> None:
    assert_one_line(run("evaluate"), "score what?", "give a capture, or --rooms N")
    told = run("evaluate", "mine", "--rooms", 2)
    assert_one_line(told, "not scored together", "leave out --rooms or mine")


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_no_types_of_python(run: Run, command: str) -> None:
    assert "{None}" not in run(command, "--help").out


TRAINING_NONSENSE = {
    "--learning-rate nan": "learning_rate must be finite, got nan",
    "--learning-rate 0": "learning_rate must be positive, got 0.0",
    "--data.workers -1": "workers must be at least 0, got -1",
    "--num-keypoints 0": "num_keypoints must be at least 8, got 0",
    "--loss.depth inf": "depth must be finite, got inf",
    "--checkpoint-every 0": "too few steps, --checkpoint-every 0: give 1 or more",
    "--start-step -1": "too few steps, --start-step -1: give 0 or more",
}


@pytest.mark.parametrize("options", TRAINING_NONSENSE)
def test_training_refuses_nonsense(run: Run, tmp_path: Path, options: str) -> None:
    told = run("train", "--out", tmp_path / "run", *options.split())
    assert_one_line(told, f"deltas: {TRAINING_NONSENSE[options]}")
    assert not (tmp_path / "run").exists()


def test_training_is_refused_where_nothing_can_be_written(run: Run, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("mine")
    assert_one_line(run("train", "--out", file), "this is a file", str(file), "--out")
    for out in (file / "run", Path("/proc/run")):
        assert_one_line(run("train", "--out", out), "cannot be written", str(out))
    assert file.read_text() == "mine"


def test_what_is_refused_later_leaves_no_folder(run: Run, tmp_path: Path) -> None:
    root, out = tmp_path / "none", tmp_path / "runs" / "new"
    told = run("train", "--out", out, "--data", "scannet", "--root", root, "--encoder", "none")
    assert_one_line(told, "no such folder", str(root))
    told = run("evaluate", root, "--json", tmp_path / "runs" / "s.json")
    assert_one_line(told, "does not exist", str(root))
    assert not (tmp_path / "runs").exists()
