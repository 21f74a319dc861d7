"""The command: what it writes, what it says, and one line for everything that is wrong."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from run_command import Run, assert_one_line

from deltas_nets import cli
from deltas_nets.commands.command_line import parse
from deltas_nets.commands.train import Train
from deltas_nets.config import TRAIN_CONFIGS, DetectorConfig, MatcherConfig, NetworkConfig
from deltas_nets.network.deltas import Deltas
from deltas_nets.outputs.folder import OutputFolder
from deltas_nets.outputs.products import read_depth_png, read_points_ply
from deltas_nets.weights_file import save_weights

MakeCapture = Callable[..., Path]


@pytest.fixture(scope="session")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small untrained network: the command is tested here, not its accuracy."""
    config = NetworkConfig(
        detector=DetectorConfig(num_keypoints=48), matcher=MatcherConfig(num_samples=32)
    )
    file = tmp_path_factory.mktemp("weights") / "small.safetensors"
    save_weights(file, Deltas(config), {"step": "0"})
    return file


def test_depth_fills_the_folder_as_promised(
    run: Run, make_capture: MakeCapture, weights: Path, tmp_path: Path
) -> None:
    capture, out = make_capture(), tmp_path / "out"
    result = run("depth", capture, "--out", out, "--views", 3, "--weights", weights)
    assert result.code == 0, result.err
    assert result.err == ""
    for id in range(4):
        with Image.open(out / "depth" / f"{id}.png") as image:
            assert (image.size, image.mode) == ((64, 48), "I;16")
            assert (np.asarray(image) > 0).all()
        with Image.open(out / "confidence" / f"{id}.png") as image:
            assert (image.size, image.mode) == ((64, 48), "L")
        points, colors = read_points_ply(out / "points" / f"{id}.ply")
        assert len(points) == len(colors) > 500
    summary = json.loads((out / "summary.json").read_text())
    assert summary["status"] == "complete"
    assert summary["settings"]["weights"]["step"] == "0"
    assert {frame["status"] for frame in summary["frames"].values()} == {"ok"}
    assert all(len(frame["sources"]) == 2 for frame in summary["frames"].values())


def test_points_lie_on_the_depth_map_seen_from_the_world(
    run: Run, make_capture: MakeCapture, weights: Path, tmp_path: Path
) -> None:
    capture, out = make_capture(origin=(7.0, 0, 0)), tmp_path / "out"
    assert run("depth", capture, "--out", out, "--weights", weights).code == 0
    points, _ = read_points_ply(out / "points" / "1.ply")
    depth = read_depth_png(out / "depth" / "1.png")
    local = points - [7.15, 0, 0]  # frame 1 stands 15 cm to the right of the origin
    columns = np.rint(64 * local[:, 0] / local[:, 2] + 31.5).astype(int)
    rows = np.rint(64 * local[:, 1] / local[:, 2] + 23.5).astype(int)
    assert np.abs(depth[rows, columns] - local[:, 2]).max() < 0.002  # m


def test_a_stopped_run_is_continued_and_another_refused(
    run: Run, make_capture: MakeCapture, weights: Path, tmp_path: Path
) -> None:
    capture, out = make_capture(), tmp_path / "out"
    command = ["depth", capture, "--out", out, "--views", 2, "--weights", weights]
    assert run(*command).code == 0
    (out / "depth" / "2.png").unlink()
    kept = (out / "depth" / "1.png").stat().st_mtime_ns
    assert run(*command).code == 0
    assert (out / "depth" / "2.png").exists()
    assert (out / "depth" / "1.png").stat().st_mtime_ns == kept
    other = [*command, "--depth-range", 0.4, 8]
    assert_one_line(run(*other), "other settings", "summary.json", "--overwrite")
    assert run(*other, "--overwrite").code == 0


def test_bfloat16_is_nearly_as_exact_and_another_setting(
    run: Run, make_capture: MakeCapture, weights: Path, tmp_path: Path
) -> None:
    capture = make_capture()
    command = ["depth", capture, "--views", 2, "--weights", weights, "--out"]
    assert run(*command, tmp_path / "whole").code == 0
    assert run(*command, tmp_path / "half", "--precision", "bfloat16").code == 0
    whole, half = (
        read_depth_png(tmp_path / name / "depth" / "1.png") for name in ("whole", "half")
    )
    assert 0 < np.median(np.abs(half / whole - 1)) < 0.03
    said = run(*command, tmp_path / "half")
    assert_one_line(said, 'precision was "bfloat16", is "float32"', "--overwrite")


def test_another_capture_with_the_same_ids_is_not_taken_for_finished(
    run: Run, make_capture: MakeCapture, weights: Path, tmp_path: Path
) -> None:
    first, second = make_capture(path=tmp_path / "one"), make_capture(path=tmp_path / "two")
    out = tmp_path / "out"
    assert run("depth", first, "--out", out, "--weights", weights).code == 0
    assert_one_line(run("depth", second, "--out", out, "--weights", weights), "other settings")
    text = (first / "intrinsic" / "intrinsic_color.txt").read_text()
    (first / "intrinsic" / "intrinsic_color.txt").write_text(text.replace("64.0", "60.0"))
    assert_one_line(run("depth", first, "--out", out, "--weights", weights), "capture")


def test_a_continued_run_keeps_the_records_of_the_first(
    run: Run, make_capture: MakeCapture, weights: Path, tmp_path: Path
) -> None:
    command = ["depth", make_capture(), "--out", tmp_path / "out", "--weights", weights]
    run(*command)
    again = run(*command)
    assert "0 depth maps" in again.out
    assert "4 kept" in again.out
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert all("seconds" in frame for frame in summary["frames"].values())


def test_a_stopped_run_says_so_and_keeps_what_is_finished(
    run: Run,
    make_capture: MakeCapture,
    weights: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    finished, calls = OutputFolder.write_frame, []

    def stops_at_the_third(*arguments: Any, **more: Any) -> None:
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        finished(*arguments, **more)

    command = ["depth", make_capture(), "--out", tmp_path / "out", "--weights", weights]
    with monkeypatch.context() as patch:
        patch.setattr(OutputFolder, "write_frame", stops_at_the_third)
        stopped = run(*command)
    assert stopped.code == 130
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["status"], len(summary["frames"])) == ("stopped", 2)
    assert "2 kept" in run(*command).out


def test_overwriting_leaves_other_peoples_files(
    run: Run, make_capture: MakeCapture, weights: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    (out / "points").mkdir(parents=True)
    (out / "points" / "mine.ply").write_text("mine")
    command = ["depth", make_capture(), "--out", out, "--weights", weights]
    assert_one_line(run(*command), "holds something else", "--overwrite")
    for _ in range(2):
        assert run(*command, "--overwrite").code == 0
        assert (out / "points" / "mine.ply").read_text() == "mine"


def test_no_capture_is_ever_written_into(
    run: Run, make_capture: MakeCapture, weights: Path, tmp_path: Path
) -> None:
    capture, other = make_capture(path=tmp_path / "one"), make_capture(path=tmp_path / "two")
    before = (other / "depth" / "0.png").read_bytes()
    for out in (capture, other):
        command = ["depth", capture, "--out", out, "--weights", weights, "--overwrite"]
        assert_one_line(run(*command), "capture", "another folder")
    assert (other / "depth" / "0.png").read_bytes() == before


def test_cameras_in_one_place_are_warned_of(
    run: Run, make_capture: MakeCapture, weights: Path, tmp_path: Path
) -> None:
    capture, out = make_capture(step=0.0, origin=(3.1, -2.7, 11.3)), tmp_path / "out"
    result = run("depth", capture, "--out", out, "--weights", weights)
    assert result.code == 0
    assert "4 maps without a triangulated point are guesses" in result.err
    frames = json.loads((out / "summary.json").read_text())["frames"].values()
    assert {frame["status"] for frame in frames} == {"no point triangulated"}


def test_shards_share_the_work(
    run: Run, make_capture: MakeCapture, weights: Path, tmp_path: Path
) -> None:
    capture, out = make_capture(), tmp_path / "out"
    for shard in ("1/2", "2/2"):
        arguments = ["depth", capture, "--out", out, "--weights", weights, "--shard", shard]
        assert run(*arguments).code == 0
    assert len(list((out / "depth").iterdir())) == 4
    assert json.loads((out / "summary.json").read_text())["status"] == "complete"


def test_size_and_confidence_are_obeyed(
    run: Run, make_capture: MakeCapture, weights: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    arguments = ["depth", make_capture(), "--out", out, "--weights", weights]
    assert run(*arguments, "--size", 40, 50, "--min-confidence", 1).code == 0
    depth = read_depth_png(out / "depth" / "0.png")
    assert depth.shape == (40, 50)
    assert (depth == 0).all()


def test_lost_poses_are_left_out_with_one_warning(
    run: Run, make_capture: MakeCapture, weights: Path, tmp_path: Path
) -> None:
    capture, out = make_capture(), tmp_path / "out"
    (capture / "pose" / "2.txt").write_text("-inf " * 16)
    result = run("depth", capture, "--out", out, "--weights", weights)
    assert result.code == 0
    assert result.err.count("\n") == 1
    assert "frames without a usable pose are left out: 2" in result.err
    assert not (out / "depth" / "2.png").exists()
    assert json.loads((out / "summary.json").read_text())["lost_poses"] == [2]


def test_a_device_that_is_none_is_one_line(run: Run, make_capture: MakeCapture) -> None:
    told = run("depth", make_capture(), "--out", "out", "--device", "toaster")
    assert_one_line(told, "--device toaster", "use cpu")


def test_what_a_config_refuses_is_said_in_its_own_words(run: Run, tmp_path: Path) -> None:
    for options, words in (
        (["--network.detector.num-keypoints", "2"], "num_keypoints must be at least 8, got 2"),
        (["--data.shelf", "0"], "replay and shelf must be at least 1, got 1 and 0"),
        (["--data.replay", "5"], "batch_size must be a multiple of data.replay, got 6 and 5"),
    ):
        told = run("train", "--out", tmp_path / "run", *options)
        assert_one_line(told, f"deltas: {words}, command line: see deltas train --help")
    assert not (tmp_path / "run").exists()


def test_debug_shows_the_traceback(run: Run, tmp_path: Path) -> None:
    with pytest.raises(Exception, match="does not exist"):
        run("depth", tmp_path / "none", "--out", tmp_path / "out", "--debug")


def test_evaluate_prints_a_table_and_writes_json(
    run: Run, make_capture: MakeCapture, weights: Path, tmp_path: Path
) -> None:
    capture, out = make_capture(), tmp_path / "out"
    run("depth", capture, "--out", out, "--weights", weights)
    shown = run("evaluate", capture, "--weights", weights, "--json", tmp_path / "a.json")
    assert shown.code == 0
    assert "Abs Rel" in shown.out
    from_network = json.loads((tmp_path / "a.json").read_text())
    again = run("evaluate", capture, "--predictions", out, "--json", tmp_path / "b.json")
    assert again.code == 0, again.err
    from_files = json.loads((tmp_path / "b.json").read_text())
    for name in ("abs_rel", "delta1", "coverage"):
        expected = from_network["metrics"]["dense"][name]
        assert from_files["metrics"]["dense"][name] == pytest.approx(expected, abs=2e-3)
    assert "sparse points" in from_network["metrics"]


def test_evaluate_without_maps_or_truth_is_one_line(
    run: Run, make_capture: MakeCapture, tmp_path: Path
) -> None:
    capture = make_capture(path=tmp_path / "with")
    assert_one_line(
        run("evaluate", capture, "--predictions", tmp_path / "none"), "summary.json", "run it first"
    )
    blind = make_capture(path=tmp_path / "without", depth_size=None)
    assert_one_line(run("evaluate", blind), "no sensor depth")
    (tmp_path / "afile").write_text("")
    assert_one_line(run("evaluate", capture, "--json", tmp_path / "afile" / "x.json"), "afile")


def test_anchors_without_depth_are_left_out_of_the_scores(
    run: Run, make_capture: MakeCapture, weights: Path, tmp_path: Path
) -> None:
    capture = make_capture()
    (capture / "depth" / "1.png").unlink()
    result = run("evaluate", capture, "--weights", weights, "--json", tmp_path / "a.json")
    assert result.code == 0
    assert "1 anchors without sensor depth" in result.err
    assert len(json.loads((tmp_path / "a.json").read_text())["abs_rel_by_frame"]) == 3


def test_train_resume_and_refusal(run: Run, tmp_path: Path) -> None:
    out = tmp_path / "run"
    tiny = ["--data.num-rooms", 2, "--data.num-views", 2, "--max-views", 2, "--data.height", 48]
    tiny += ["--data.width", 64, "--data.workers", 0, "--sizes", 48, 64, "--batch-size", 1]
    tiny += ["--num-keypoints", 48, "--network.matcher.num-samples", 32, "--encoder", "none"]
    assert run("train", "--out", out, "--steps", 2, *tiny).code == 0
    assert (out / "weights.safetensors").exists()
    assert_one_line(run("train", "--out", out, *tiny), "another run", "--resume")
    shipped = run("train", "--out", tmp_path / "on", "--steps", 1, *tiny, "--init", "deltas-small")
    assert shipped.code == 0, shipped.err
    missing = ["--out", tmp_path / "no", "--init", "deltas-large"]
    assert_one_line(run("train", *missing), "no such weights, deltas-large", "deltas-small")
    assert not (tmp_path / "no").exists()
    assert run("train", "--out", out, "--resume").code == 0
    assert_one_line(run("train", "--out", tmp_path / "x", "--resume"), "nothing to resume")
    fresh = ["train", "--out", tmp_path / "x"]
    assert_one_line(run(*fresh, "--steps", 0), "steps")
    assert_one_line(run(*fresh, "--sizes", 10, 10), "sizes", "32 or more")
    assert_one_line(run(*fresh, "--start-step", 3), "--init FILE")
    weights = out / "weights.safetensors"
    late = ["--init", weights, "--start-step", 9, "--steps", 5]
    assert_one_line(run(*fresh, *late), "--start-step", "ends at 5")
    longer = run("train", "--out", out, "--resume", "--steps", 9)
    assert_one_line(
        longer, "steps 2, not 9", f"--init {out / 'weights.safetensors'} --start-step 2"
    )
    assert "start a new run" in run("train", "--out", out, "--resume", "--steps", 1).err
    assert_one_line(run("depth", "x", "--out", "y", "--weights", out / "checkpoint.pt"), "x")
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("command", ["demo", "depth", "evaluate", "train", "distill"])
def test_every_command_explains_itself_with_an_example(run: Run, command: str) -> None:
    result = run(command, "--help")
    assert result.code == 0
    assert f"Example: deltas {command}" in " ".join(result.out.split())


def test_the_version_is_told(run: Run) -> None:
    from deltas_nets import __version__

    assert run("--version").out == f"deltas-depth {__version__}\n"


def test_cost_prints_every_stage_and_writes_json(run: Run, tmp_path: Path) -> None:
    file = tmp_path / "cost.json"
    said = run("cost", "deltas-small", "--size", 48, 64, "--repeats", 1, "--json", file)
    assert said.code == 0, said.err
    for stage in ("encoder", "detector", "descriptor", "matcher", "densifier", "geometry"):
        assert stage in said.out
    assert "deltas-small" in json.loads(file.read_text())["networks"]


def test_a_config_sets_the_defaults_and_flags_change_them() -> None:
    arguments = ["train", "--out", "x", "--config", "deltas-vgg9", "--steps", "5000"]
    command = parse(arguments, cli.COMMANDS)
    assert isinstance(command, Train)
    wanted = dataclasses.replace(TRAIN_CONFIGS["deltas-vgg9"], steps=5000)
    assert command.config == wanted and command.config.batch_size == 24
    small = parse(["train", "--out", "x"], cli.COMMANDS)
    assert isinstance(small, Train) and small.config == TRAIN_CONFIGS["deltas-small"]
