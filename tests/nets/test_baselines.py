"""Baselines by the names that `--weights` takes: the same commands, and refusals by name."""

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from room_capture import write_scene
from run_command import Run, assert_one_line

from deltas_nets.baselines import colmap_points
from deltas_nets.baselines.colmap import interpolated
from deltas_nets.baselines.given_points import TruePoints
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.captures.work_size import depth_at_image
from deltas_nets.config.baselines import BASELINES
from deltas_nets.config.varied import NetworkSettings
from deltas_nets.errors import UserError
from deltas_nets.outputs.products import read_depth_png
from deltas_nets.predict.depth_map import PredictConfig, frames_of
from deltas_nets.predict.look import look
from deltas_nets.predict.predictor import load_predictor
from deltas_nets.predict.reach import Reach
from deltas_nets.rooms import render_room

SIZE = (120, 160)
SETS = ViewSet("0", ("1", "2"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A room of three views with sensor depth; never written to."""
    path = tmp_path_factory.mktemp("baselines") / "room"
    write_scene(path, render_room(5000, num_views=3, image_size=SIZE))
    sets = [{"anchor": 0, "sources": [1, 2]}]
    (path / "view_sets.json").write_text(json.dumps(sets))
    return path


@pytest.fixture(scope="module")
def room(folder: Path) -> Capture:
    return open_capture(folder)


def relative_error(name: str, room: Capture) -> np.ndarray:
    """Of a map of the first frame, where the sensor sees something in range."""
    predictor, config = load_predictor(name), PredictConfig()
    predictor.check_asked(config, room, [SETS])
    found = look(predictor, frames_of(room, SETS), config, Reach(0.5, 10.0))
    truth = depth_at_image(room.frame("0"))
    assert found.depth.shape == SIZE and np.isfinite(found.depth).all()
    known = (truth > 0.5) & (truth < 10)
    error: np.ndarray = np.abs(found.depth / truth - 1)[known]
    return error


@pytest.mark.parametrize("name", BASELINES)
def test_every_baseline_is_a_predictor_that_names_itself(name: str) -> None:
    if name.startswith("colmap"):
        pytest.importorskip("pycolmap")
    predictor = load_predictor(name)
    network = "deltas-small" if name == "no-points" else name
    assert predictor.network_record()["name"] == network
    with pytest.raises(UserError, match=f"{network} has no such setting"):
        predictor.varied(NetworkSettings(offset=1.0))


def test_a_baseline_has_no_stages_to_export_or_calibrate() -> None:
    with pytest.raises(UserError, match="no stages"):
        load_predictor("plane-sweep").deltas("no stages", "here", "mend it")


def test_evaluate_and_depth_take_a_baseline_by_name(run: Run, folder: Path, tmp_path: Path) -> None:
    flags = ("--weights", "plane-sweep", "--view-sets", folder / "view_sets.json")
    said = run("evaluate", folder, *flags, "--json", tmp_path / "scores.json")
    assert said.code == 0, said.err
    assert "plane-sweep" in (tmp_path / "scores.json").read_text()
    said = run("depth", folder, *flags, "--out", tmp_path / "out")
    assert said.code == 0, said.err
    assert "no confidence is written: what --weights names states none" in said.out
    depth = read_depth_png(tmp_path / "out" / "depth" / "0.png")
    truth = depth_at_image(open_capture(folder).frame("0"))
    assert np.median(np.abs(depth / truth - 1)) < 0.1


def test_true_points_beat_none(room: Capture) -> None:
    true, none = relative_error("true-points", room), relative_error("no-points", room)
    assert np.median(true) < 0.03
    assert true.mean() < 0.5 * none.mean()


def test_true_points_are_the_sensors_in_the_unit_that_is_seen(room: Capture) -> None:
    """Searched in another unit the points come back as the capture has them."""
    predictor, config = load_predictor("true-points"), PredictConfig()
    predictor.check_asked(config, room, [SETS])
    near = look(predictor, frames_of(room, SETS), config, Reach(0.5, 10.0))
    far = look(predictor, frames_of(room, SETS), config, Reach(0.25, 5.0, unit=2.0))
    np.testing.assert_allclose(far.keypoints.depth, near.keypoints.depth, rtol=1e-5)
    truth = torch.from_numpy(depth_at_image(room.frame("0")))
    assert len(near.keypoints.depth) == 512
    assert near.keypoints.depth.max() <= truth.max()


def test_true_points_need_a_sensor_and_metres(room: Capture, tmp_path: Path) -> None:
    predictor = TruePoints()
    without = tmp_path / "room"
    write_scene(without, render_room(5000, num_views=2, image_size=(48, 64)))
    for file in (without / "depth").iterdir():
        file.unlink()
    with pytest.raises(UserError, match="needs sensor depth, and frame 0 has none"):
        predictor.check_asked(PredictConfig(), open_capture(without), [ViewSet("0", ("1",))])


@pytest.mark.parametrize(
    ("flags", "parts"),
    [
        (("--min-confidence", 0.5), ("states no confidence", "--min-confidence")),
        (("--sensor-depth", "sensor"), ("takes no measured depth",)),
        (("--precision", "bfloat16"), ("runs in float32 alone", "--precision bfloat16")),
    ],
)
def test_what_a_baseline_cannot_is_refused(
    run: Run, folder: Path, tmp_path: Path, flags: tuple[object, ...], parts: tuple[str, ...]
) -> None:
    said = run(
        "depth", folder, "--out", tmp_path / "out", "--weights", "plane-sweep", "--views", 2, *flags
    )
    assert_one_line(said, *parts)
    assert not (tmp_path / "out").exists()


def test_a_wrong_name_is_no_baseline(run: Run, folder: Path) -> None:
    assert_one_line(run("evaluate", folder, "--weights", "plain-sweep"), "no such weights")


def test_without_pycolmap_the_extra_is_named(
    run: Run, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    for name in ("colmap-sparse", "colmap-densified"):
        said = run("evaluate", folder, "--weights", name)
        assert_one_line(said, "pycolmap", 'pip install "deltas-depth[colmap]"')
    said = run("ablate", "sparse", folder, "--out", tmp_path / "ablations")
    assert_one_line(said, "pycolmap", 'pip install "deltas-depth[colmap]"')
    assert list(tmp_path.iterdir()) == []


def test_colmap_refuses_what_its_cameras_cannot_say(room: Capture) -> None:
    pytest.importorskip("pycolmap")
    anchor, *sources = frames_of(room, SETS)
    K = anchor.K + np.array([[0, 1.5, 0], [0, 0, 0], [0, 0, 0]])
    with pytest.raises(UserError, match="is skewed"):
        colmap_points.sparse_points([replace(anchor, K=K), *sources], (0.5, 10.0))


def test_points_of_colmap_are_on_the_surfaces(room: Capture) -> None:
    pytest.importorskip("pycolmap")
    found = colmap_points.sparse_points(frames_of(room, SETS), (0.5, 10.0))
    truth = depth_at_image(room.frame("0"))
    columns, rows = (found.pixels + 0.5).floor().long().numpy().T
    error = np.abs(found.depth.numpy() / truth[rows, columns] - 1)
    assert len(error) >= 10
    assert np.median(error) < 0.02


def test_maps_of_colmaps_points_beat_none(room: Capture) -> None:
    pytest.importorskip("pycolmap")
    none = relative_error("no-points", room).mean()
    assert relative_error("colmap-densified", room).mean() < none
    assert relative_error("colmap-sparse", room).mean() < none


def test_a_plane_is_interpolated_exactly() -> None:
    """Inverse depth of a plane is linear in the image."""
    random = np.random.default_rng(0)
    corners = np.array([[-1.0, -1], [20, -1], [-1, 15], [20, 15]])
    pixels = np.concatenate([corners, random.random((30, 2)) * [19, 14]])
    inverse = 0.2 + 0.01 * pixels[:, 0] + 0.02 * pixels[:, 1]
    rows, columns = np.mgrid[:15, :20]
    expected = 1 / (0.2 + 0.01 * columns + 0.02 * rows)
    np.testing.assert_allclose(interpolated(pixels, 1 / inverse, (15, 20)), expected, rtol=1e-5)


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_few_points_on_a_line_still_make_a_map(count: int) -> None:
    pixels = np.array([[1.0, 1], [3, 3], [5, 5]])[:count]
    depth = interpolated(pixels, np.array([1.0, 2.0, 4.0])[:count], (6, 8))
    assert np.isin(depth, [1.0, 2.0, 4.0] if count else [0.0]).all()


def test_colmap_finds_nothing_in_images_without_texture(
    make_capture: Callable[..., Path],
) -> None:
    pytest.importorskip("pycolmap")
    folder = make_capture(num_frames=3)
    for file in (folder / "color").iterdir():
        Image.new("RGB", (64, 48), "grey").save(file)
    capture, config = open_capture(folder), PredictConfig()
    for name, least in (("colmap-sparse", 0.0), ("colmap-densified", 0.1)):
        found = look(load_predictor(name), frames_of(capture, SETS), config, Reach(0.5, 10.0))
        assert len(found.keypoints.depth) == 0
        assert np.isfinite(found.depth).all() and (found.depth >= least).all()
