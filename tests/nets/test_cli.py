"""The command: what it writes, what it says, and one line for everything that is wrong."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from deltas_nets import cli
from deltas_nets.config import DetectorConfig, MatcherConfig, NetworkConfig
from deltas_nets.network.deltas import Deltas
from deltas_nets.outputs import read_depth_png, read_points_ply
from deltas_nets.pretrained import save_weights

MakeCapture = Callable[..., Path]
Run = Callable[..., "Result"]


class Result:
    """What a command left behind."""

    def __init__(self, code: int, out: str, err: str) -> None:
        self.code, self.out, self.err = code, out, err


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Run:
    """Run `deltas` with arguments, in this process."""

    def run(*arguments: object) -> Result:
        monkeypatch.setattr(sys, "argv", ["deltas", *map(str, arguments)])
        code = 0
        try:
            cli.main()
        except SystemExit as stopped:
            code = int(stopped.code or 0)
        captured = capfd.readouterr()
        return Result(code, captured.out, captured.err)

    return run


@pytest.fixture(scope="session")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small untrained network: the command is tested here, not its accuracy."""
    config = NetworkConfig(
        detector=DetectorConfig(num_keypoints=48), matcher=MatcherConfig(num_samples=32)
    )
    file = tmp_path_factory.mktemp("weights") / "small.safetensors"
    save_weights(file, Deltas(config), {"step": "0"})
    return file


def assert_one_line(result: Result, *parts: str) -> None:
    assert result.code == 2
    assert result.err.startswith("deltas: ")
    assert result.err.count("\n") == 1
    for part in parts:
        assert part in result.err, result.err


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
    assert "1 frames without a usable pose" in result.err
    assert not (out / "depth" / "2.png").exists()
    assert json.loads((out / "summary.json").read_text())["lost_poses"] == 1


def break_pose(folder: Path) -> None:
    (folder / "pose" / "1.txt").write_text("nan " * 16)


def cut_image(folder: Path) -> None:
    file = folder / "color" / "1.jpg"
    file.write_bytes(file.read_bytes()[:-400])


def drop_poses(folder: Path) -> None:
    for file in (folder / "pose").iterdir():
        file.unlink()
    (folder / "pose").rmdir()


def shrink_intrinsics(folder: Path) -> None:
    (folder / "intrinsic" / "intrinsic_color.txt").write_text("1 2 3")


@pytest.mark.parametrize(
    ("damage", "file", "remedy"),
    [
        (break_pose, "pose/1.txt", "repair it"),
        (cut_image, "color/1.jpg", "copy the file again"),
        (drop_poses, "capture", "put a 4x4"),
        (shrink_intrinsics, "intrinsic_color.txt", "write the 4x4"),
    ],
)
def test_a_bad_capture_is_one_line_and_nothing_is_written(
    run: Run,
    make_capture: MakeCapture,
    tmp_path: Path,
    damage: Callable[[Path], None],
    file: str,
    remedy: str,
) -> None:
    capture, sets, out = make_capture(), tmp_path / "sets.json", tmp_path / "out"
    sets.write_text('[{"anchor": 0, "sources": [1, 2]}]')
    damage(capture)
    assert_one_line(run("depth", capture, "--out", out, "--view-sets", sets), file, remedy)
    assert not out.exists()


def test_wrong_options_are_one_line(run: Run, make_capture: MakeCapture, tmp_path: Path) -> None:
    capture, out = make_capture(), tmp_path / "out"
    base = ["depth", capture, "--out", out]
    assert_one_line(run("depth", tmp_path / "none", "--out", out), "none", "check the path")
    assert_one_line(run(*base, "--weights", "nope"), "nope", "deltas-small")
    assert_one_line(run(*base, "--device", "toaster"), "--device toaster", "use cpu")
    assert_one_line(run(*base, "--depth-range", 3, 1), "--depth-range", "NEAR < FAR")
    assert_one_line(run(*base, "--shard", "3/2"), "--shard 3/2", "I/N")
    assert_one_line(run(*base, "--views", 1), "--views 1", "2 or more")
    assert_one_line(run(*base, "--size", 4, 4), "--size", "32 or more")
    assert not out.exists()


def test_a_file_is_no_output_folder(run: Run, make_capture: MakeCapture, tmp_path: Path) -> None:
    taken = tmp_path / "taken"
    taken.write_text("mine")
    assert_one_line(run("depth", make_capture(), "--out", taken), "taken", "--out")
    assert taken.read_text() == "mine"


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
        run("evaluate", capture, "--predictions", tmp_path / "none"), "0.png", "run deltas depth"
    )
    blind = make_capture(path=tmp_path / "without", depth_size=None)
    assert_one_line(run("evaluate", blind), "no sensor depth")


def test_train_resume_and_refusal(run: Run, tmp_path: Path) -> None:
    out = tmp_path / "run"
    tiny = ["--data.num-rooms", 2, "--data.num-views", 2, "--max-views", 2, "--data.height", 48]
    tiny += ["--data.width", 64, "--data.workers", 0, "--sizes", 48, 64, "--batch-size", 1]
    tiny += ["--num-keypoints", 48, "--network.matcher.num-samples", 32, "--encoder", "none"]
    assert run("train", "--out", out, "--steps", 2, *tiny).code == 0
    assert (out / "weights.safetensors").exists()
    assert_one_line(run("train", "--out", out, *tiny), "another run", "--resume")
    assert run("train", "--out", out, "--resume").code == 0
    assert_one_line(run("train", "--out", tmp_path / "x", "--resume"), "nothing to resume")
    assert_one_line(run("train", "--out", tmp_path / "x", "--steps", 0), "steps")


@pytest.mark.parametrize("command", ["demo", "depth", "evaluate", "train"])
def test_every_command_explains_itself_with_an_example(run: Run, command: str) -> None:
    result = run(command, "--help")
    assert result.code == 0
    assert f"Example: deltas {command}" in " ".join(result.out.split())


def test_help_does_not_wait_for_torch() -> None:
    code = "import sys, deltas_nets.cli; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
