"""`deltas depth` in two passes, by threads, killed and continued; and with measured depth."""

import contextlib
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from run_command import Result, Run, assert_one_line

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.work_size import depth_at_image
from deltas_nets.network.known_depth import KnownDepth
from deltas_nets.outputs.depth_formats import read_depth_map
from deltas_nets.outputs.first_maps import FIRST, FirstMaps
from deltas_nets.outputs.folder import OutputFolder

IDS = [str(id) for id in range(5)]


@pytest.fixture(scope="session")
def scene(scannet_root: Path) -> Path:
    return scannet_root / "scans" / "scene0000_00"


@pytest.fixture
def depth(run: Run, scene: Path, tmp_path: Path) -> Any:
    sets = tmp_path / "sets.json"
    listed = [{"anchor": id, "sources": [(id + 1) % 5, (id + 2) % 5]} for id in range(5)]
    sets.write_text(json.dumps(listed))

    def depth(name: str, *flags: object) -> Result:
        fixed = ("--out", tmp_path / name, "--format", "npz", "--no-page", "--view-sets", sets)
        return run("depth", scene, *fixed, "--work-size", 64, 96, *flags)

    return depth


def maps(folder: Path) -> np.ndarray:
    return np.stack([read_depth_map(folder, id, 1000) for id in IDS])


def truth_of(capture: Capture) -> np.ndarray:
    return np.stack([depth_at_image(capture.frame(id)) for id in IDS])


def error(found: np.ndarray, true: np.ndarray) -> float:
    known = (true > 0.5) & (true < 10)
    return float((np.abs(found - true)[known] / true[known]).mean())


def test_maps_that_hear_each_other_are_the_same_however_they_are_made(
    depth: Any, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert depth("once", "--passes", 1).code == 0
    said = depth("whole", "--workers", 1)
    assert said.code == 0 and "at a time" not in said.out
    assert not (tmp_path / "whole" / FIRST).exists()
    assert depth("threads", "--workers", 3).code == 0
    assert np.allclose(maps(tmp_path / "threads"), maps(tmp_path / "whole"), rtol=1e-5)

    # Stopped in the first pass, in the second and in the third, and finished.
    keep, write, calls = FirstMaps.write, OutputFolder.write_frame, []

    def stopped(function: Any, at: int) -> Any:
        def call(*arguments: Any) -> None:
            calls.append(1)
            if len(calls) == at:
                raise KeyboardInterrupt
            function(*arguments)

        return call

    monkeypatch.setattr(FirstMaps, "write", stopped(keep, 4))
    said = depth("broken", "--workers", 1, "--overwrite")
    assert said.code == 130 and "goes on, without --overwrite once maps" in said.err
    monkeypatch.setattr(FirstMaps, "write", stopped(keep, 8))
    assert depth("broken", "--workers", 1).code == 130
    first = tmp_path / "broken" / FIRST
    assert (len(list(first.glob("*.*"))), len(list(first.glob("*/*.*")))) == (5, 1)
    monkeypatch.setattr(FirstMaps, "write", keep)
    monkeypatch.setattr(OutputFolder, "write_frame", stopped(write, 11))
    assert depth("broken", "--workers", 1).code == 130
    assert (len(list(first.glob("*.*"))), len(list(first.glob("*/*.*")))) == (5, 5)
    (first / "4.safetensors").write_bytes(b"cut")
    (first / "pass-2" / "3.safetensors").write_bytes(b"cut")
    monkeypatch.setattr(OutputFolder, "write_frame", write)
    assert depth("broken", "--workers", 1).code == 0
    assert np.allclose(maps(tmp_path / "broken"), maps(tmp_path / "whole"), rtol=1e-5)

    assert not np.allclose(maps(tmp_path / "whole"), maps(tmp_path / "once"), rtol=1e-2)
    assert depth("twice", "--passes", 2).code == 0
    assert not np.allclose(maps(tmp_path / "whole"), maps(tmp_path / "twice"), rtol=1e-4)
    # Another network's first maps are not taken for ours, and shards leave each other's alone.
    left = FirstMaps(tmp_path / "broken", (2, 2))
    left.write("0", KnownDepth(torch.ones(1, 4, 4), torch.ones(1, 4, 4)), {})
    assert depth("broken", "--shard", "1/2", "--overwrite").code == 0 and left.file("0").exists()
    assert depth("broken", "--overwrite", "--passes", 1).code == 0 and not left.file("0").exists()
    left.write("0", KnownDepth(torch.ones(1, 4, 4), torch.ones(1, 4, 4)), {})
    assert depth("broken", "--passes", 1).code == 0 and not left.file("0").exists()
    summary = json.loads((tmp_path / "whole" / "summary.json").read_text())
    assert all("valid_points" in frame for frame in summary["frames"].values())


def test_sources_that_get_no_map_are_heard_all_the_same(
    run: Run, scene: Path, tmp_path: Path
) -> None:
    sets = tmp_path / "sets.json"
    sets.write_text('[{"anchor": 2, "sources": [1, 3]}]')
    fixed = ("--format", "npz", "--no-page", "--view-sets", sets, "--work-size", 64, 96)
    found = {}
    for name, passes in (("alone", 1), ("heard", 2)):
        out = tmp_path / name
        assert run("depth", scene, "--out", out, *fixed, "--passes", passes).code == 0
        assert [file.stem for file in (out / "depth").iterdir()] == ["2"]
        found[name] = read_depth_map(out, "2", 1000)
    assert not np.allclose(found["alone"], found["heard"], rtol=1e-3)


def test_measured_depth_makes_maps_better_and_alone_completes_them(
    depth: Any, scene: Path, tmp_path: Path
) -> None:
    true = truth_of(open_capture(scene))
    rows = []
    for id, map_ in zip(IDS, true, strict=True):
        for row, column in np.argwhere(map_ > 0)[::400]:
            rows.append(f"{id} {column} {row} {map_[row, column]:.4f}")
    file = tmp_path / "by_hand.txt"
    file.write_text("\n".join(rows))
    assert depth("none", "--passes", 1).code == 0
    errors = {"none": error(maps(tmp_path / "none"), true)}
    for name, flags in {
        "by-hand": ("--sensor-depth", file),
        "sensor": ("--sensor-depth", "sensor"),
        "alone": ("--sensor-depth", "sensor", "--views", 1),
    }.items():
        said = depth(name, "--passes", 1, *flags)
        assert said.code == 0, said.err
        errors[name] = error(maps(tmp_path / name), true)
    assert errors["by-hand"] < 0.8 * errors["none"]
    assert errors["sensor"] < 0.5 * errors["none"]
    assert errors["alone"] < 0.5 * errors["none"]


@pytest.mark.parametrize("passes", [1, 3])
def test_measured_depth_of_another_unit_is_doubted(
    depth: Any, scene: Path, tmp_path: Path, passes: int
) -> None:
    true, file = truth_of(open_capture(scene)), tmp_path / "feet.txt"
    places = [np.argwhere(map_ > 0)[::400] for map_ in true]
    file.write_text(
        "".join(
            f"{id} {column} {row} {map_[row, column] / 0.3048:.4f}\n"
            for id, map_, found in zip(IDS, true, places, strict=True)
            for row, column in found
        )
    )
    said = depth("feet", "--passes", passes, "--sensor-depth", file)
    assert said.code == 0 and "times as far as what matches triangulate to" in said.err
    said = depth("metres", "--passes", passes, "--sensor-depth", "sensor")
    assert said.code == 0 and "times as far" not in said.err


def test_measured_depth_that_is_damaged_is_named_before_anything_is_written(
    depth: Any, scene: Path, tmp_path: Path
) -> None:
    damaged = scene / "depth" / f"{IDS[-1]}.png"
    whole = damaged.read_bytes()
    damaged.write_bytes(whole[:200])
    said = depth("damaged", "--sensor-depth", "sensor")
    damaged.write_bytes(whole)
    assert_one_line(said, str(damaged))
    assert not (tmp_path / "damaged").exists()


def test_maps_of_one_image_hear_no_others(depth: Any, scene: Path, tmp_path: Path) -> None:
    completed = ("--sensor-depth", "sensor", "--views", 1)
    assert depth("whole", *completed).code == 0
    assert depth("once", "--passes", 1, *completed).code == 0
    assert np.array_equal(maps(tmp_path / "whole"), maps(tmp_path / "once"))


@pytest.mark.parametrize(
    ("flags", "parts"),
    [
        (("--views", 1), ("--views 1", "--sensor-depth")),
        (("--passes", 10), ("--passes 10",)),
        (("--workers", 0), ("--workers 0",)),
        (("--sensor-depth", "points"), ("no sparse points",)),
        (("--sensor-depth", "nowhere.txt"), ("nowhere.txt",)),
        (("--sensor-depth", "sensor", "--sensor-deviation", 2), ("--sensor-deviation 2",)),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_written(
    depth: Any, tmp_path: Path, flags: tuple[object, ...], parts: tuple[str, ...]
) -> None:
    assert_one_line(depth("out", *flags), *parts)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_ten_kills_at_random_change_nothing(depth: Any, scene: Path, tmp_path: Path) -> None:
    fixed = ["--format", "npz", "--no-page", "--views", "3", "--work-size", "64", "96"]
    command = [sys.executable, "-m", "deltas_nets.cli", "depth", str(scene), *fixed, "--out"]
    began = time.monotonic()
    subprocess.run([*command, str(tmp_path / "whole")], check=True)
    whole, random = time.monotonic() - began, np.random.default_rng(0)
    for _ in range(10):
        process = subprocess.Popen([*command, str(tmp_path / "killed")])
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(random.uniform(0.3, 1.0) * whole)
        process.kill()
        process.wait()
    subprocess.run([*command, str(tmp_path / "killed")], check=True)
    assert not (tmp_path / "killed" / FIRST).exists()
    assert np.allclose(maps(tmp_path / "killed"), maps(tmp_path / "whole"), rtol=1e-5)
