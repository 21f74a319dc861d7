"""`deltas evaluate` over scenes: what is scored, counted, refused and written."""

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from run_command import Result, Run, assert_one_line
from small_capture import write_capture

from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.saving import save_capture
from deltas_nets.captures.scaled import in_metres
from deltas_nets.commands.evaluate import Evaluate
from deltas_nets.errors import UserError
from deltas_nets.evaluate.record import read_record
from deltas_nets.evaluate.room_scores import room_in_files
from deltas_nets.evaluate.scenes import named_scenes, scenes_in
from deltas_nets.rooms import render_room

MakeCapture = Callable[..., Path]
QUICK = ("--views", 2, "--num-points", 64)


class Evaluated:
    """Runs the command and reads what it wrote."""

    def __init__(self, run: Run, folder: Path) -> None:
        self.run, self.folder = run, folder

    def __call__(self, *arguments: object, code: int = 0) -> dict[str, Any]:
        files = ["--json", self.folder / "scores.json", "--csv", self.folder / "scores.csv"]
        self.told: Result = self.run("evaluate", *arguments, *files)
        assert self.told.code == code, self.told.err
        content: dict[str, Any] = json.loads((self.folder / "scores.json").read_text())
        return content

    def rows(self) -> list[dict[str, str]]:
        with (self.folder / "scores.csv").open() as file:
            return list(csv.DictReader(file))


@pytest.fixture
def evaluated(run: Run, tmp_path: Path) -> Evaluated:
    (tmp_path / "written").mkdir()
    return Evaluated(run, tmp_path / "written")


@pytest.fixture
def two_scenes(tmp_path: Path) -> Path:
    """Scenes of three and two frames; of the second's maps every pixel is larger in the world."""
    for name, frames in (("a", 3), ("b", 2)):
        write_capture(tmp_path / "scenes" / name, frames, depth_size=(24, 32))
    return tmp_path / "scenes"


def broken(image: Path) -> None:
    image.write_bytes(image.read_bytes()[:200])


def test_all_is_the_mean_over_frames_of_the_scenes(two_scenes: Path, evaluated: Evaluated) -> None:
    said = evaluated(two_scenes, *QUICK)
    assert "a" in evaluated.told.out and "all" in evaluated.told.out
    rows, frames = said["rows"], said["frames"]
    assert [row["scene"] for row in rows if row["scores"] == "dense"] == ["a", "b", "all"]
    assert [(f["scene"], f["frame"]) for f in frames] == [
        *(("a", str(id)) for id in range(3)),
        *(("b", str(id)) for id in range(2)),
    ]
    every = next(row for row in rows if row["scene"] == "all" and row["scores"] == "dense")
    for name in ("abs_rel", "rmse", "delta103", "ause"):
        assert every[name] == pytest.approx(np.mean([f[name] for f in frames])), name
    assert every["frames"] == 5
    assert every["abs_rel"] == said["metrics"]["dense"]["abs_rel"]
    assert next(iter(said["abs_rel_by_frame"])) == "a/0"
    for way, prefix in (("median-scaled", "median_"), ("scale and shift", "scale_shift_")):
        row = next(r for r in rows if r["scene"] == "all" and r["scores"] == way)
        assert row["rmse"] == pytest.approx(np.mean([f[f"{prefix}rmse"] for f in frames]))
        assert row["rmse"] != pytest.approx(every["rmse"], rel=1e-3)
    # All maps have as many pixels here, so that pooling changes roots alone.
    pooled = next(row for row in rows if row["scene"] == "all" and row["scores"] == "pooled")
    assert pooled["abs_rel"] == pytest.approx(every["abs_rel"])
    assert pooled["rmse"] == pytest.approx(np.sqrt(np.mean([f["rmse"] ** 2 for f in frames])))
    assert said["calibration"]["pixels"] == 5 * 48 * 64
    table = evaluated.rows()
    assert [row["abs_rel"] for row in table] == [str(f["abs_rel"]) for f in frames]
    assert table[0]["sources"] == said["frames"][0]["sources"] != ""


def test_what_is_written_says_what_made_it(two_scenes: Path, evaluated: Evaluated) -> None:
    evaluated(two_scenes / "a", *QUICK, "--truth-size", "own")
    record = read_record(evaluated.folder / "scores.json")
    assert record.table == "depth"
    assert record.protocol["views"] == {"name": "chosen", "version": 1, "views": 2}
    assert record.protocol["truth_size"] == "own"
    assert record.protocol["settings"] == {"num_points": 64}
    assert record.weights["deltas-small"]["network"]["detector"]["num_keypoints"] == 64
    assert record.weights["deltas-small"]["sha256"]
    assert {"deltas", "torch"} <= record.versions.keys()
    assert {"processor", "threads"} <= record.machine.keys()
    assert record.command.startswith("deltas evaluate a --views 2")
    assert list(record.data) == [{"name": "a", "view_sets": 3}]


def test_files_are_there_whatever_becomes_of_what_is_printed(
    two_scenes: Path, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def gone(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Evaluate, "_print", gone)
    files = ["--json", tmp_path / "a.json", "--csv", tmp_path / "a.csv"]
    assert run("evaluate", two_scenes / "b", *QUICK, *files).code == 130
    assert (tmp_path / "a.json").exists()
    assert (tmp_path / "a.csv").exists()


def test_scenes_are_found_in_folders_and_lists(two_scenes: Path, tmp_path: Path) -> None:
    assert [path.name for path in scenes_in(two_scenes)] == ["a", "b"]
    assert scenes_in(two_scenes / "b") == [two_scenes / "b"]
    listed = two_scenes / "split.txt"
    listed.write_text("b\n")
    assert named_scenes((), listed) == {"b": two_scenes / "b"}
    elsewhere = tmp_path / "split.txt"
    elsewhere.write_text("b\na\n")
    assert list(named_scenes((two_scenes,), elsewhere)) == ["b", "a"]
    same_name = write_capture(tmp_path / "other" / "a", 2)
    assert list(named_scenes((two_scenes, same_name))) == ["scenes/a", "scenes/b", "other/a"]


def test_frames_that_fail_are_counted_and_the_rest_is_scored(
    two_scenes: Path, evaluated: Evaluated
) -> None:
    broken(two_scenes / "a" / "color" / "2.jpg")  # no source of others
    said = evaluated(two_scenes, *QUICK, code=1)
    assert "that failed: 1" in evaluated.told.err
    assert "a/2" in evaluated.told.err
    status = [f["status"] for f in said["frames"]]
    assert status == ["ok", "ok", "failed", "ok", "ok"]
    assert "2.jpg" in said["failed"]["a/2"]
    every = next(row for row in said["rows"] if row["scene"] == "all")
    assert (every["frames"], every["failed"]) == (4, 1)
    assert evaluated.rows()[2]["abs_rel"] == ""


def test_scenes_that_fail_are_counted_and_the_rest_is_scored(
    two_scenes: Path, evaluated: Evaluated, run: Run
) -> None:
    (two_scenes / "a" / "intrinsic" / "intrinsic_color.txt").unlink()
    said = evaluated(two_scenes, *QUICK, code=1)
    assert "intrinsic_color.txt" in said["failed_scenes"]["a"]
    assert [row["scene"] for row in said["rows"] if row["scores"] == "dense"] == ["b", "all", "a"]
    assert list(said["abs_rel_by_frame"]) == ["b/0", "b/1"]  # as where both are scored
    assert_one_line(run("evaluate", two_scenes / "a"), "intrinsic_color.txt")
    for image in (two_scenes / "b" / "color").iterdir():
        broken(image)
    refused = run("evaluate", two_scenes / "b")
    assert refused.code == 2 and "0.jpg" in refused.err


def test_the_papers_protocol_on_rooms_in_scannets_layout(
    scannet_root: Path, evaluated: Evaluated
) -> None:
    asked = ("--data", "scannet", "--protocol", "paper", "--gap", 2, "--every", 3)
    said = evaluated(scannet_root, *asked)
    assert said["protocol"]["views"]["gap"] == 2
    assert [(f["frame"], f["sources"]) for f in said["frames"]] == [("3", "1 5"), ("6", "4 8")]
    assert said["data"] == [{"name": "scene0707_00", "view_sets": 2}]
    both = evaluated(scannet_root, *asked, "--split", "train", *QUICK)
    assert {f["scene"] for f in both["frames"]} == {"scene0000_00", "scene0706_01"}
    assert both["frames"][0]["sources"] == "1"  # of two views the earlier one


@pytest.mark.shared
def test_the_scannet_sample_is_scored(shared_data: Path, evaluated: Evaluated) -> None:
    root = shared_data / "scannet_sample"
    asked = ("--data", "scannet", "--protocol", "paper", "--gap", 1, "--every", 1)
    own, at_map = (
        evaluated(root, *asked, "--truth-size", size)["metrics"]["dense"] for size in ("own", "map")
    )
    assert own["coverage"] > 0.95  # the depth camera sees a little more
    assert own["abs_rel"] == pytest.approx(at_map["abs_rel"], abs=0.01)


def test_pairs_as_dpsnet_prepared_them_are_scored_both_ways(
    tmp_path: Path, evaluated: Evaluated
) -> None:
    pairs = tmp_path / "pairs"
    for seed in range(2):
        room = render_room(seed, num_views=2, image_size=(96, 128))
        folder = pairs / f"room_{seed:03d}"
        folder.mkdir(parents=True)
        np.savetxt(folder / "cam.txt", room.views.K[0].numpy())
        np.savetxt(folder / "poses.txt", room.views.cam_from_world[:, :3].reshape(2, 12).numpy())
        for i in range(2):
            pixels = room.images[i].permute(1, 2, 0).numpy()
            Image.fromarray(pixels).save(folder / f"{i:04d}.jpg", quality=95)
            np.save(folder / f"{i:04d}.npy", room.depth[i].numpy())
    said = evaluated(pairs)
    assert [(f["scene"], f["frame"], f["sources"]) for f in said["frames"]] == [
        ("room_000", "0000", "0001"),
        ("room_000", "0001", "0000"),
        ("room_001", "0000", "0001"),
        ("room_001", "0001", "0000"),
    ]
    assert said["metrics"]["dense"]["coverage"] == 1
    assert said["metrics"]["dense"]["abs_rel"] < 0.5
    (pairs / "room_000" / "0001.jpg").unlink()
    lacks = "one frame of the capture can be used (0000); no image: 0001"
    assert_one_line(evaluated.run("evaluate", pairs / "room_000"), lacks)


def test_a_sample_of_robust_mvd_says_which_file_its_truth_would_be(
    run: Run, tmp_path: Path
) -> None:
    room_in_files(render_room(2, num_views=2, image_size=(48, 64)), tmp_path / "sample")
    (tmp_path / "sample" / "key" / "depth.npy").unlink()
    (tmp_path / "sample" / "source" / "1" / "depth.npy").unlink()
    assert_one_line(run("evaluate", tmp_path / "sample"), "add key/depth.npy")


def test_maps_in_files_are_scored_scene_by_scene(
    two_scenes: Path, evaluated: Evaluated, run: Run, tmp_path: Path
) -> None:
    for name in ("a", "b"):
        asked = ("--views", 2, "--depth-range", 0.5, 10, "--no-page", "--passes", 1)
        asked += ("--work-size", 48, 64)  # networks are scored on small photos as they are
        out = tmp_path / "maps" / name
        assert run("depth", two_scenes / name, "--out", out, *asked).code == 0
    direct = evaluated(two_scenes, "--views", 2, "--consistency")
    said = evaluated(two_scenes, "--predictions", tmp_path / "maps", "--consistency")
    assert said["protocol"]["views"]["name"] == "as predicted"
    for name in ("abs_rel", "delta1", "coverage"):
        expected = direct["metrics"]["dense"][name]
        assert said["metrics"]["dense"][name] == pytest.approx(expected, abs=2e-3)
    assert "ause" not in said  # maps in files state no deviation
    found = (scores["scenes"]["a"]["consistency"] for scores in (direct, said))
    assert next(found) == pytest.approx(next(found), abs=5e-3)
    # Another program leaves maps alone; a file says which there must be.
    (tmp_path / "maps" / "b" / "summary.json").unlink()
    sets = tmp_path / "sets.json"
    sets.write_text('[{"anchor": 0, "sources": [1]}]')
    other = evaluated(
        two_scenes / "b", "--predictions", tmp_path / "maps" / "b", "--view-sets", sets
    )
    assert other["abs_rel_by_frame"] == {"0": said["abs_rel_by_frame"]["b/0"]}
    (tmp_path / "maps" / "a" / "depth" / "1.png").unlink()
    gone = evaluated(two_scenes / "a", "--predictions", tmp_path / "maps" / "a", code=1)
    assert list(gone["failed"]) == ["1"]
    summary = tmp_path / "maps" / "a" / "summary.json"
    said = json.loads(summary.read_text()) | {"status": "stopped", "waiting_for": ["2/2"]}
    summary.write_text(json.dumps(said))
    evaluated(two_scenes / "a", "--predictions", tmp_path / "maps" / "a", code=1)
    assert "the folder is complete after --shard 2/2" in evaluated.told.warnings[0]


def test_view_sets_may_lie_in_each_scene(two_scenes: Path, evaluated: Evaluated) -> None:
    for name in ("a", "b"):
        (two_scenes / name / "sets.json").write_text('[{"anchor": 1, "sources": [0]}]')
    said = evaluated(two_scenes, "--view-sets", "sets.json")
    assert [(f["scene"], f["frame"]) for f in said["frames"]] == [("a", "1"), ("b", "1")]
    alone = evaluated(two_scenes / "b", "--view-sets", "sets.json")
    assert alone["abs_rel_by_frame"]["1"] == said["abs_rel_by_frame"]["b/1"]


def test_some_sets_of_each_scene_are_spread_over_all(
    two_scenes: Path, evaluated: Evaluated, run: Run
) -> None:
    said = evaluated(two_scenes, "--views", 2, "--sets", 2)
    assert [(f["scene"], f["frame"]) for f in said["frames"]] == [
        ("a", "0"),
        ("a", "1"),
        ("b", "0"),
        ("b", "1"),
    ]
    assert said["protocol"]["views"]["sets"] == 2
    assert [scene["view_sets"] for scene in said["data"]] == [2, 2]
    assert_one_line(run("evaluate", two_scenes, "--sets", 0), "--sets 0")


def test_what_was_not_measured_is_a_dash_and_null(
    make_capture: MakeCapture, evaluated: Evaluated
) -> None:
    said = evaluated(make_capture(2), "--sets", 1, "--consistency")
    assert said["consistency"]["flicker"] is None
    assert "flicker of successive maps - (0 pairs)" in evaluated.told.out
    assert "nan" not in (evaluated.folder / "scores.json").read_text().lower()


def test_what_the_supplement_varies_is_a_flag(
    make_capture: MakeCapture, evaluated: Evaluated, run: Run
) -> None:
    capture = make_capture(2)
    none = evaluated(capture, "--num-points", 0)
    assert "sparse points" not in none["metrics"]
    assert none["weights"]["deltas-small"]["network"]["without_points"]
    some = evaluated(capture, "--detected-share", 1, "--nms-radius", 2, "--threshold", 0.01)
    assert some["weights"]["deltas-small"]["network"]["detector"]["nms_radius"] == 2
    refused = run("evaluate", capture, "--offset", 2)
    assert_one_line(refused, "deltas-small has no such setting, --offset")
    assert_one_line(run("evaluate", capture, "--num-points", 3), "num_points must be 0")


def test_a_scene_is_called_as_it_was_named_also_through_a_link(
    two_scenes: Path, tmp_path: Path
) -> None:
    link = tmp_path / "walk"
    link.symlink_to(two_scenes / "a", target_is_directory=True)
    assert list(named_scenes([link])) == ["walk"]
    with pytest.raises(UserError, match="a scene is named twice"):
        named_scenes([link, two_scenes / "a"])


def test_contradictions_are_refused_in_one_line(two_scenes: Path, run: Run, tmp_path: Path) -> None:
    a, b = two_scenes / "a", two_scenes / "b"
    sets = tmp_path / "sets.json"
    sets.write_text("[]")
    for arguments, said in (
        ((a, "--gap", 3), "--gap"),
        ((a, "--protocol", "paper", "--gap", 0), "--gap 0"),
        ((a, "--protocol", "paper"), "no frame that 20 divides"),
        ((a, "--protocol", "paper", "--view-sets", sets), "--view-sets"),
        ((a, b, "--data", "scannet"), "a data set is one folder"),
        ((two_scenes, "--data", "scannet"), "none of the 2 scenes (a, b) is in the split test"),
        ((a, a), "a scene is named twice"),
        ((a, tmp_path / "none"), "the capture does not exist"),
        ((a, "--scenes", sets), "1 of 1 scenes are not there"),
        ((a, b, "--scenes", sets), "relative to one folder"),
        ((a, "--view-sets", "none.json"), "none.json"),
        ((a, "--predictions", b, "--num-points", 64), "--predictions"),
        ((a, "--predictions", b, "--weights", "plane-sweep"), "--weights"),
        ((a, "--predictions", b, "--work-size", 64, 96), "--work-size"),
        ((a, "--predictions", b, "--views", 7), "--views"),
        ((a, "--split", "all"), "--split: it goes with --data scannet"),
        ((a, "--conditions", "ideal"), "--conditions"),
        ((a, "--every", 3), "--every"),
        (("--rooms", 1, "--consistency"), "--rooms"),
    ):
        assert_one_line(run("evaluate", *arguments), said)


def test_depth_in_another_unit_is_told_from_none(run: Run, tmp_path: Path) -> None:
    metres = open_capture(write_capture(tmp_path / "walk", 3))
    own = replace(in_metres(replace(metres, metric=False), 1000.0), metric=False)
    save_capture(own, tmp_path / "millimetres", "own")
    command = ["evaluate", tmp_path / "millimetres", "--weights", "plane-sweep", "--sets", 1]
    result = run(*command)
    assert result.code == 2 and "is outside 0.5 to 10" in result.err
    assert "--depth-range NEAR FAR in the capture's own unit" in result.err
    result = run(*command, "--depth-range", 500, 10000)
    assert result.code == 0 and "in its own unit, not in metres" in result.err
    for label in ("Abs, units", "Sq Rel, units", "RMSE, units"):
        assert label in result.out
    assert ", m " not in result.out
    several = ("evaluate", tmp_path / "walk", tmp_path / "millimetres", *command[2:])
    result = run(*several, "--depth-range", 0.5, 10000)
    assert result.code == 0 and "Abs, units" in result.out
    assert "Abs, m " in run("evaluate", tmp_path / "walk", *command[2:]).out
