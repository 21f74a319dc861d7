"""The command: what it writes and says. What it refuses is in messages.txt."""

import dataclasses
import errno
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from run_command import Result, Run, assert_one_line
from run_fit import HELD_OUT
from small_capture import write_capture

from deltas_nets import __version__, cli
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.commands.command_line import parse
from deltas_nets.commands.depth import Depth
from deltas_nets.commands.train import Train
from deltas_nets.config import TRAIN_CONFIGS, DetectorConfig, MatcherConfig, NetworkConfig
from deltas_nets.network.deltas import Deltas
from deltas_nets.outputs import products
from deltas_nets.outputs.products import read_depth_png, read_points_ply
from deltas_nets.predict.passes import Passes
from deltas_nets.train import fit
from deltas_nets.weights_file import save_weights

MakeCapture = Callable[..., Path]
COMMANDS = [command.__name__.lower() for command in cli.COMMANDS]


@pytest.fixture(scope="session")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small untrained network: the command is tested here, not its accuracy."""
    config = NetworkConfig(
        detector=DetectorConfig(num_keypoints=48), matcher=MatcherConfig(num_samples=32)
    )
    file = tmp_path_factory.mktemp("weights") / "small.safetensors"
    with torch.random.fork_rng():  # the same network whatever ran before
        torch.manual_seed(0)
        save_weights(file, Deltas(config), {"step": "0"})
    return file


@dataclasses.dataclass
class DepthCommand:
    """`deltas depth` of one capture into one folder, unless told otherwise."""

    run: Run
    capture: Path
    out: Path
    weights: Path

    def __call__(self, *options: object, capture: Path | None = None) -> Result:
        """Options come last, so they win."""
        where = ["depth", capture or self.capture, "--out", self.out, "--weights", self.weights]
        return self.run(*where, *options)

    def summary(self) -> dict[str, Any]:
        content: dict[str, Any] = json.loads((self.out / "summary.json").read_text())
        return content

    def map(self, id: int) -> np.ndarray:
        return read_depth_png(self.out / "depth" / f"{id}.png")


@pytest.fixture
def depth(run: Run, make_capture: MakeCapture, weights: Path, tmp_path: Path) -> DepthCommand:
    return DepthCommand(run, make_capture(), tmp_path / "out", weights)


def test_depth_fills_the_folder_as_promised(depth: DepthCommand) -> None:
    result = depth("--views", 3)
    assert result.code == 0 and not result.warnings
    for id in range(4):
        with Image.open(depth.out / "depth" / f"{id}.png") as image:
            assert (image.size, image.mode) == ((64, 48), "I;16")
            assert (np.asarray(image) > 0).all()
        with Image.open(depth.out / "confidence" / f"{id}.png") as image:
            assert (image.size, image.mode) == ((64, 48), "L")
        points, colors = read_points_ply(depth.out / "points" / f"{id}.ply")
        assert len(points) == len(colors) > 500
    summary = depth.summary()
    assert summary["status"] == "complete"
    assert summary["settings"]["weights"]["step"] == "0"
    assert {frame["status"] for frame in summary["frames"].values()} == {"ok"}
    # Ids that are numbers stay numbers in JSON.
    assert summary["anchors"] == [0, 1, 2, 3] and list(summary["frames"]) == ["0", "1", "2", "3"]
    for id, (anchor, sources) in enumerate(summary["settings"]["view_sets"]):
        assert (anchor, sources) == (id, summary["frames"][str(id)]["sources"])
        assert len(sources) == 2 and set(sources) < {0, 1, 2, 3}


@pytest.mark.parametrize("origin", [(7.0, 0, 0), (441547.5, 5121946.5, 312)])
def test_points_lie_on_the_depth_map_seen_from_the_world(
    depth: DepthCommand, make_capture: MakeCapture, tmp_path: Path, origin: tuple[float, ...]
) -> None:
    capture = make_capture(path=tmp_path / "far", origin=origin)
    assert depth(capture=capture).code == 0
    points, _ = read_points_ply(depth.out / "points" / "1.ply")
    local = points - np.array(origin) - [0.15, 0, 0]  # where frame 1 stands
    columns = np.rint(64 * local[:, 0] / local[:, 2] + 31.5).astype(int)
    rows = np.rint(64 * local[:, 1] / local[:, 2] + 23.5).astype(int)
    assert np.abs(depth.map(1)[rows, columns] - local[:, 2]).max() < 0.002  # m


def test_a_run_is_continued_and_another_refused(depth: DepthCommand) -> None:
    assert depth("--views", 2).code == 0
    (depth.out / "depth" / "2.png").unlink()
    kept = (depth.out / "depth" / "1.png").stat().st_mtime_ns
    again = depth("--views", 2)
    assert "1 depth map in" in again.out and "3 kept" in again.out
    assert (depth.out / "depth" / "2.png").exists()
    assert (depth.out / "depth" / "1.png").stat().st_mtime_ns == kept
    assert all("seconds" in frame for frame in depth.summary()["frames"].values())
    other = ["--views", 2, "--depth-range", 0.4, 8]
    assert_one_line(depth(*other), "other settings", "summary.json", "--overwrite")
    assert depth(*other, "--overwrite").code == 0


def test_bfloat16_is_nearly_as_exact_and_another_setting(depth: DepthCommand) -> None:
    once = ["--views", 2, "--passes", 1]
    assert depth(*once).code == 0
    whole = depth.map(1)
    half = [*once, "--precision", "bfloat16"]
    assert_one_line(depth(*half), 'precision was "float32", is "bfloat16"', "--overwrite")
    assert depth(*half, "--overwrite").code == 0
    off = np.median(np.abs(depth.map(1) / whole - 1))
    assert 0 < off < 0.06


def test_another_capture_with_the_same_ids_is_not_taken_for_finished(
    depth: DepthCommand, make_capture: MakeCapture, tmp_path: Path
) -> None:
    assert depth().code == 0
    another = make_capture(path=tmp_path / "two")
    assert_one_line(depth(capture=another), "one of its cameras differs")
    file = depth.capture / "intrinsic" / "intrinsic_color.txt"
    file.write_text(file.read_text().replace("64.0", "60.0"))
    assert_one_line(depth(), "one of its cameras differs")


def test_overwriting_leaves_other_peoples_files(depth: DepthCommand) -> None:
    (depth.out / "points").mkdir(parents=True)
    (depth.out / "points" / "mine.ply").write_text("mine")
    for _ in range(2):
        assert depth("--overwrite").code == 0
        assert (depth.out / "points" / "mine.ply").read_text() == "mine"


def test_no_capture_is_ever_written_into(
    depth: DepthCommand, make_capture: MakeCapture, tmp_path: Path
) -> None:
    other = make_capture(path=tmp_path / "two")
    before = (other / "depth" / "0.png").read_bytes()
    for out in (depth.capture, other):
        assert_one_line(depth("--out", out, "--overwrite"), "capture", "another folder")
    assert (other / "depth" / "0.png").read_bytes() == before


def test_cameras_in_one_place_are_warned_of(
    depth: DepthCommand, make_capture: MakeCapture, tmp_path: Path
) -> None:
    still = make_capture(path=tmp_path / "still", step=0.0, origin=(3.1, -2.7, 11.3))
    result = depth(capture=still)
    assert result.code == 0
    assert "a guess where no point was triangulated: 4 maps" in result.err
    frames = depth.summary()["frames"].values()
    assert {frame["status"] for frame in frames} == {"no point triangulated"}


def test_shards_share_the_work(depth: DepthCommand) -> None:
    first = depth("--shard", "1/2")
    assert "--shard 2/2" in first.out and depth.summary()["status"] == "stopped"
    second = depth("--shard", "2/2")
    assert "--shard" not in second.out and depth.summary()["status"] == "complete"
    assert len(list((depth.out / "depth").iterdir())) == 4


def test_a_shard_looks_at_no_frame_for_another(
    depth: DepthCommand, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked, see = [], Passes._see

    def seen(self: Passes, views: ViewSet) -> None:
        looked.append(views.anchor)
        see(self, views)

    monkeypatch.setattr(Passes, "_see", seen)
    depth.capture = write_capture(depth.capture.parent / "six", 6)
    assert depth("--shard", "1/2", "--workers", 1, "--no-page").code == 0
    assert looked == ["0", "2", "4"]


def test_another_scale_is_known_to_who_reads_the_maps(depth: DepthCommand, tmp_path: Path) -> None:
    errors = []
    for scale in (100, 1000):
        assert depth("--depth-scale", scale, "--overwrite").code == 0
        score = ["--predictions", depth.out, "--json", tmp_path / "s.json"]
        assert depth.run("evaluate", depth.capture, *score).code == 0
        scores = json.loads((tmp_path / "s.json").read_text())
        errors.append(scores["metrics"]["dense"]["abs_rel"])
    assert errors[0] == pytest.approx(errors[1], abs=0.002)  # half a centimetre at 2.5 m
    assert "depth_scale" not in depth.summary()["settings"]  # as before there was another scale
    assert_one_line(depth("--depth-scale", 100), "--depth-scale was null, is 100.0")


def test_depth_beyond_the_file_is_a_warning(
    depth: DepthCommand, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert depth().code == 0
    scale = 65534 / np.median(depth.map(0))
    monkeypatch.setattr(products, "check_depth_fits", lambda *_: None)
    told = depth("--depth-scale", scale, "--overwrite")
    assert told.code == 0 and f"--depth-scale {scale / 10:g}" in told.err
    assert depth.summary()["frames"]["0"]["saturated_pixels"] == pytest.approx(48 * 32, rel=0.05)


def test_maps_that_are_left_without_depth_are_told(depth: DepthCommand) -> None:
    told = depth("--min-confidence", 1, "--mesh")
    assert told.code == 0
    assert "4 maps without any depth: no pixel is as sure as --min-confidence 1" in told.err
    assert "no pixel of the maps has depth, " in told.err  # which no other setting of fuse mends
    assert all(record["empty"] for record in depth.summary()["frames"].values())


def test_size_and_confidence_are_obeyed(depth: DepthCommand) -> None:
    assert depth("--size", 40, 50, "--min-confidence", 1).code == 0
    assert depth.map(0).shape == (40, 50) and (depth.map(0) == 0).all()


def test_lost_poses_are_left_out_with_one_warning(depth: DepthCommand) -> None:
    (depth.capture / "pose" / "2.txt").write_text("-inf " * 16)
    result = depth()
    assert result.code == 0 and len(result.warnings) == 1
    assert "frames without a usable pose are left out: 2" in result.err
    assert not (depth.out / "depth" / "2.png").exists()
    assert depth.summary()["lost_poses"] == [2]


@pytest.mark.parametrize("place", ["a-file", "a-file/below", "filled"])
def test_a_place_that_cannot_be_filled_is_told_before_anything_is_computed(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    monkeypatch.setattr(Depth, "predictor", lambda _: pytest.fail("a network was loaded"))
    (tmp_path / "filled").mkdir()
    (tmp_path / "filled" / "notes.txt").touch()
    (tmp_path / "a-file").touch()
    result = run("depth", write_capture(tmp_path / "capture"), "--out", tmp_path / place)
    assert_one_line(result, place, "name a")


def test_folders_of_captures_with_dots_in_their_names_do_not_collide(tmp_path: Path) -> None:
    for name in ("scene.1", "scene.2"):
        (tmp_path / name).mkdir()
        assert Depth(capture=tmp_path / name).folder == Path(f"{name}-depth")
    (tmp_path / "frames.json").touch()
    assert Depth(capture=tmp_path / "frames.json").folder == Path("frames-depth")


def test_an_option_of_another_command_is_told_whose_it_is(run: Run, tmp_path: Path) -> None:
    said = run("depth", tmp_path, "--glb")
    assert_one_line(said, "no option --glb here: deltas fuse has it", "deltas depth --help")


def test_debug_shows_the_traceback(run: Run, tmp_path: Path) -> None:
    with pytest.raises(Exception, match="does not exist"):
        run("depth", tmp_path / "none", "--out", tmp_path / "out", "--debug")


def test_evaluate_prints_a_table_and_writes_json(depth: DepthCommand, tmp_path: Path) -> None:
    def scores(*options: object) -> tuple[str, dict[str, Any]]:
        told = depth.run("evaluate", depth.capture, *options, "--json", tmp_path / "a.json")
        assert told.code == 0, told.err
        return told.out, json.loads((tmp_path / "a.json").read_text())

    depth("--passes", 1, "--work-size", 48, 64)  # networks are scored on small photos as they are
    shown, from_network = scores("--weights", depth.weights)
    assert "Abs Rel" in shown and "sparse points" in from_network["metrics"]
    _, from_files = scores("--predictions", depth.out)
    for name in ("abs_rel", "delta1", "coverage"):
        expected = from_network["metrics"]["dense"][name]
        assert from_files["metrics"]["dense"][name] == pytest.approx(expected, abs=2e-3)


def test_anchors_without_depth_are_left_out_of_the_scores(
    depth: DepthCommand, tmp_path: Path
) -> None:
    (depth.capture / "depth" / "1.png").unlink()
    told = depth.run(
        "evaluate", depth.capture, "--weights", depth.weights, "--json", tmp_path / "a"
    )
    assert told.code == 0 and "1 anchors without sensor depth" in told.err
    assert list(json.loads((tmp_path / "a").read_text())["abs_rel_by_frame"]) == ["0", "2", "3"]


def test_train_resume_and_refusal(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"
    tiny = ["--data.num-rooms", 2, "--data.num-views", 2, "--max-views", 2, "--data.height", 48]
    tiny += ["--data.width", 64, "--data.workers", 0, "--sizes", 48, 64, "--batch-size", 1]
    tiny += ["--num-keypoints", 48, "--network.matcher.num-samples", 32, "--encoder", "none"]
    monkeypatch.setattr(fit, "validation_rooms", lambda: HELD_OUT)
    assert run("train", "--out", out, "--steps", 2, *tiny).code == 0
    assert (out / "weights.safetensors").exists()
    assert_one_line(run("train", "--out", out, *tiny), "another run", "--resume")
    shipped = run("train", "--out", tmp_path / "on", "--steps", 1, *tiny, "--init", "deltas-small")
    assert shipped.code == 0, shipped.err
    assert run("train", "--out", out, "--resume").code == 0
    late = ["--init", out / "weights.safetensors", "--start-step", 9, "--steps", 5]
    assert_one_line(run("train", "--out", tmp_path / "x", *late), "--start-step", "ends at 5")
    longer = run("train", "--out", out, "--resume", "--steps", 9)
    assert_one_line(
        longer, "steps 2, not 9", f"--init {out / 'weights.safetensors'} --start-step 2"
    )
    assert "start a new run" in run("train", "--out", out, "--resume", "--steps", 1).err
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself_with_an_example(run: Run, command: str) -> None:
    result = run(command, "--help")
    assert result.code == 0 and "{None}" not in result.out
    assert "FLOAT FLOAT" not in result.out, "say what the numbers are"
    assert f"Example: deltas {command}" in " ".join(result.out.split())


def test_a_number_that_is_missing_is_told(run: Run, tmp_path: Path) -> None:
    said = run("export", "--depth-range", 1, "--out", tmp_path / "x.pt2")
    assert_one_line(said, "--depth-range takes 2 values, got fewer", "see deltas export --help")


def test_without_arguments_the_help_is_shown(run: Run) -> None:
    shown = run()
    assert (shown.code, shown.err) == (0, "") and shown.out == run("--help").out
    assert all(command in shown.out for command in COMMANDS)
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


@pytest.mark.parametrize("command", ["depth", "check", "evaluate", "view", "convert", "page"])
def test_a_path_at_which_the_system_does_not_look_is_told(
    command: str, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    more = {"convert": [tmp_path / "out"], "page": [tmp_path]}.get(command, [])
    assert_one_line(run(command, 300 * "x", *more), "refuses this path (File name too long)")

    def forbidden(path: Path) -> bool:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    for name in ("exists", "is_dir", "is_file"):
        monkeypatch.setattr(Path, name, forbidden)
    assert_one_line(run(command, tmp_path / "shut", *more), "refuses", "(Permission denied)")
