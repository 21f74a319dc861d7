"""`deltas depth` of captures without metres, through lenses, in formats of floats."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import MakeCapture
from PIL import Image
from run_command import Run, assert_one_line
from small_maps import write_maps
from test_search import Oracle

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import Lens
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.saving import save_capture
from deltas_nets.captures.scaled import scaled
from deltas_nets.commands.depth import Depth
from deltas_nets.errors import UserError
from deltas_nets.evaluate.capture import evaluate_files
from deltas_nets.outputs.depth_formats import DEPTH_FORMATS, read_depth_map, read_depth_png
from deltas_nets.outputs.summary import recorded_view_sets
from deltas_nets.outputs.their_capture import made_of
from deltas_nets.predict.depth_map import PredictConfig

UNIT = 0.05  # of the capture's units are a metre


@pytest.fixture(scope="module")
def rooms(scannet_root: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A rendered room in metres, in a unit of its own, and through a lens; without sensor depth."""
    folder = tmp_path_factory.mktemp("rooms")
    capture = open_capture(scannet_root / "scans" / "scene0000_00")
    blind = with_frames(capture, depth_path=None, depth_K=None, depth_size=None)
    bent = with_frames(blind, lens=Lens("SIMPLE_RADIAL", (-0.01,)))
    kinds = {
        "metres": blind,
        "own-unit": scaled(blind, UNIT, metric=False),
        "bent": scaled(bent, UNIT, metric=False),
    }
    for name, kind in kinds.items():
        save_capture(kind, folder / name, "colmap" if name == "bent" else "own", placing="link")
    (folder / "sets.json").write_text('[{"anchor": 0, "sources": [1, 2]}]')
    return {name: folder / name for name in (*kinds, "sets.json")}


def with_frames(capture: Capture, **values: Any) -> Capture:
    frames = [replace(frame, **values) for frame in capture.frames.values()]
    return replace(capture, frames=Frames.of(frames, capture.frames.folder))


def summary_of(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "summary.json").read_text())
    return content


def test_the_unit_of_a_capture_is_that_of_its_maps(
    run: Run, rooms: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    found = {}
    for name in ("metres", "own-unit", "bent"):
        said = run("depth", rooms[name], "--view-sets", rooms["sets.json"], "--work-size", 96, 128)
        assert said.code == 0, said.err
        out = tmp_path / f"{name}-depth"
        summary = summary_of(out)
        own = name != "metres"
        assert (summary["unit"] == "metre") != own and ("the capture's own unit" in said.out) == own
        scale = summary["settings"].get("depth_scale", 1000)
        assert (scale == 1000) != own
        found[name] = read_depth_png(out / "depth" / "0.png", scale)
        with Image.open(out / "depth" / "0.png") as image:
            assert float(image.text["depth_scale"]) == scale  # type: ignore[attr-defined]
        assert "mean confidence" in summary["verdict"]
        near, far = summary["frames"]["0"]["depth_range"]
        assert near < np.median(found[name]) < far
    apart = np.abs(found["own-unit"] / UNIT / found["metres"] - 1)
    assert np.median(apart) < 0.1
    bent = found["bent"]
    assert (bent > 0).mean() > 0.99
    assert np.median(np.abs(bent / found["own-unit"] - 1)[bent > 0]) < 0.1  # almost no lens


def test_a_scale_makes_it_metric(run: Run, rooms: dict[str, Path], tmp_path: Path) -> None:
    flags = ["--view-sets", rooms["sets.json"], "--out"]
    plain = run("depth", rooms["metres"], *flags, tmp_path / "a", "--format", "npz")
    given = run(
        "depth", rooms["own-unit"], *flags, tmp_path / "b", "--format", "npz", "--scale", 1 / UNIT
    )
    assert plain.code == given.code == 0
    assert summary_of(tmp_path / "b")["unit"] == "metre"
    first, second = (read_depth_map(tmp_path / name, "0", 1000) for name in "ab")
    assert np.allclose(first, second, rtol=1e-3)
    for wrong in (["--scale", 0], ["--scale", 2, "--scale-from", "sensor"], ["--scale-from", "x"]):
        assert run("depth", rooms["own-unit"], *flags, tmp_path / "c", *wrong).code == 2
    assert_one_line(
        run(
            "depth", rooms["metres"], *flags, tmp_path / "c", "--format", "pfm", "--depth-scale", 9
        ),
        "--depth-scale",
    )
    assert not (tmp_path / "c").exists()


def test_a_scale_is_of_depth_files_and_so_is_one_measured_by_hand(
    make_capture: MakeCapture, tmp_path: Path
) -> None:
    folder = tmp_path / "own"
    save_capture(replace(open_capture(make_capture()), metric=False), folder)
    stated = Depth(capture=folder, scale=2.0).opened(folder)
    file = tmp_path / "measured.txt"
    file.write_text("1 10 20 5")
    opened = open_capture(folder)
    found, kept = (
        Depth(capture=folder, scale_from=source).in_metres(
            opened,
            Oracle(2.5),
            PredictConfig(),  # type: ignore[arg-type]
        )
        for source in (file, Path("sensor"))
    )
    for capture, unit in ((stated, 2.0), (found, 2.0), (kept, 1.0)):
        assert capture.metric and capture.frame(1).read_depth().max() == pytest.approx(2.5 * unit)

        def right(size: tuple[int, int], depth: float = 2.5 * unit) -> np.ndarray:
            return np.full(size, depth)

        maps = write_maps(capture, tmp_path / f"maps-{id(capture)}", depth=right)
        scores = evaluate_files(maps, opened, recorded_view_sets(maps))
        assert scores.dense.abs_rel == pytest.approx(0, abs=1e-3)
        made = made_of(opened, maps).capture
        assert made.fingerprint() == capture.fingerprint()
        assert made.frame(1).read_depth().max() == pytest.approx(2.5 * unit)


@pytest.mark.parametrize("name", DEPTH_FORMATS)
def test_formats_hold_what_they_can(tmp_path: Path, name: Any) -> None:
    depth = np.array([[0.0, 0.5, 2.0], [3.25, 1.0, 60.0]], dtype=np.float32)
    (tmp_path / "depth").mkdir()
    DEPTH_FORMATS[name].write(tmp_path / "depth" / f"7.{name}", depth, 1000, "metre")
    read = read_depth_map(tmp_path, "7", 1000)
    assert read.dtype == np.float32 and np.allclose(read, depth, atol=0.0006)
    assert name == "png" or np.array_equal(read, depth)


def test_a_file_that_is_no_map_of_depth_is_named(tmp_path: Path) -> None:
    depth, bytes_ = np.ones((1, 2, 3), np.float32), np.ones((2, 3), np.uint8)
    (tmp_path / "depth").mkdir()
    np.savez(tmp_path / "depth" / "stacked.npz", depth=depth)
    Image.fromarray(bytes_).save(tmp_path / "depth" / "grey.png")
    Image.fromarray(bytes_).convert("RGB").save(tmp_path / "depth" / "colour.png")
    for id, said in (("stacked", "(1, 2, 3)"), ("grey", "got L"), ("colour", "got RGB")):
        with pytest.raises(UserError, match=rf"cannot be read .*{re.escape(said)}.*{id}"):
            read_depth_map(tmp_path, id, 1000)
