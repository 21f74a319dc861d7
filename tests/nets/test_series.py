"""One thing changed at a time: what is changed, that nothing is measured twice, and invariances."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from reference_tables import random_tables
from run_command import Run, assert_one_line
from small_capture import write_capture

from deltas_nets.ablations import measure as measuring
from deltas_nets.ablations.changes import blurred, calibrated_wrong, exposed, moved, turned
from deltas_nets.ablations.curves import CURVES, curve
from deltas_nets.ablations.disturbed import Disturbed, InUnit
from deltas_nets.ablations.journal import Journal, key_of
from deltas_nets.ablations.measure import Measurement
from deltas_nets.ablations.paper import PAPER, SPARSE_RATIO
from deltas_nets.ablations.report import draw_series, with_paper
from deltas_nets.ablations.steps import Series, Step
from deltas_nets.ablations.tables import TABLES
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import Frame
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.commands.ablate import Table
from deltas_nets.commands.robustness import Curve
from deltas_nets.config import DetectorConfig, MatcherConfig, NetworkConfig
from deltas_nets.config.varied import NetworkSettings
from deltas_nets.errors import UserError
from deltas_nets.evaluate.record import read_record
from deltas_nets.network.deltas import Deltas
from deltas_nets.predict.depth_map import PredictConfig, Wanted
from deltas_nets.predict.ours import DeltasPredictor
from deltas_nets.weights_file import save_weights

amounts = st.floats(0, 3, width=32)
seeds = st.integers(0, 1000)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    return open_capture(write_capture(tmp_path_factory.mktemp("series") / "walk", 4))


@pytest.fixture(scope="module")
def model() -> Deltas:
    config = NetworkConfig(detector=DetectorConfig(48), matcher=MatcherConfig(num_samples=32))
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return Deltas(config).eval()


@pytest.fixture(scope="module")
def weights(model: Deltas, tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("weights") / "small.safetensors"
    save_weights(file, model, {"step": "0"})
    return file


def depth_of(predictor: DeltasPredictor | Disturbed, frames: list[Frame]) -> np.ndarray:
    return predictor.depth_map(Wanted(frames, PredictConfig(work_size=(48, 64)))).depth


def all_frames(capture: Capture) -> list[Frame]:
    return [capture.frame(id) for id in capture.frames]


@settings(max_examples=6)
@given(order=st.permutations([1, 2, 3]))
def test_depth_does_not_depend_on_the_order_of_the_sources(
    order: list[int], capture: Capture, model: Deltas
) -> None:
    frames = all_frames(capture)
    mixed = [frames[0], *(frames[number] for number in order)]
    found = depth_of(DeltasPredictor(model), mixed)
    np.testing.assert_allclose(found, depth_of(DeltasPredictor(model), frames), rtol=2e-4)


@settings(max_examples=6)
@given(factor=st.sampled_from([1e-3, 0.1, 0.5, 3.0, 1e4]))
def test_depth_does_not_depend_on_a_unit_that_is_told(
    factor: float, capture: Capture, model: Deltas
) -> None:
    frames = all_frames(capture)
    told = InUnit(DeltasPredictor(model), factor, told=True)
    found = depth_of(told, frames)
    np.testing.assert_allclose(found, depth_of(DeltasPredictor(model), frames), rtol=2e-4)


@given(metres=amounts, seed=seeds)
def test_a_camera_is_moved_by_so_much_and_always_the_same_way(
    metres: float, seed: int, capture: Capture
) -> None:
    for frame in all_frames(capture):
        before, after = frame.cam_from_world, moved(metres, seed)(frame).cam_from_world
        centres = [-pose[:3, :3].T @ pose[:3, 3] for pose in (before, after)]
        assert abs(np.linalg.norm(centres[1] - centres[0]) - metres) < 1e-9
        np.testing.assert_array_equal(moved(metres, seed)(frame).cam_from_world, after)
    ways = [moved(1, seed)(frame).cam_from_world[:3, 3] for frame in all_frames(capture)]
    starts = [frame.cam_from_world[:3, 3] for frame in all_frames(capture)]
    assert len({tuple(np.round(w - s, 6)) for w, s in zip(ways, starts, strict=True)}) == 4


@given(degrees=amounts, seed=seeds)
def test_a_camera_is_turned_by_so_much_about_itself(
    degrees: float, seed: int, capture: Capture
) -> None:
    for frame in all_frames(capture):
        before, after = frame.cam_from_world, turned(degrees, seed)(frame).cam_from_world
        cosine = (np.trace(after[:3, :3] @ before[:3, :3].T) - 1) / 2
        assert abs(np.degrees(np.arccos(np.clip(cosine, -1, 1))) - degrees) < 1e-5
        centres = [-pose[:3, :3].T @ pose[:3, 3] for pose in (before, after)]
        np.testing.assert_allclose(centres[0], centres[1], atol=1e-12)


def test_a_focal_length_is_wrong_by_a_share_and_the_frame_stays_as_it_is(capture: Capture) -> None:
    frame = capture.frame("0")
    wrong = calibrated_wrong(0.02)(frame)
    assert wrong.K[0, 0] == 1.02 * frame.K[0, 0] and wrong.K[0, 2] == frame.K[0, 2]
    assert capture.frame("0").K[0, 0] == frame.K[0, 0]


def test_blur_keeps_the_mean_and_takes_contrast_at_any_size(capture: Capture) -> None:
    frame = capture.frame("0")
    sharp, soft = frame.read_image().astype(float), blurred(0.03)(frame).read_image().astype(float)
    assert abs(soft.mean() - sharp.mean()) < 1.5 and soft.std() < 0.5 * sharp.std()
    assert blurred(0.03)(frame).read_resized((24, 32)).shape == (24, 32, 3)
    np.testing.assert_array_equal(blurred(0)(frame).read_image(), frame.read_image())


@given(seed=seeds)
def test_exposure_is_one_factor_for_an_image_and_within_the_stops(
    seed: int, capture: Capture
) -> None:
    frame = capture.frame("1")
    before, after = frame.read_image().astype(float), exposed(1.0, seed)(frame).read_image()
    usable = (before > 60) & (after < 255)
    factor = after[usable] / before[usable]
    assert np.ptp(factor) < 0.03 and 2 ** (-1 / 2.2) - 0.02 < factor.mean() < 2 ** (1 / 2.2) + 0.02
    np.testing.assert_array_equal(exposed(0.0, seed)(frame).read_image(), frame.read_image())


def test_commands_know_all_series_and_tables_the_rows_of_the_paper() -> None:
    assert tuple(Curve.__args__) == CURVES and [curve(name).name for name in CURVES] == [*CURVES]
    assert set(Table.__args__) == set(TABLES) == set(PAPER)
    for name in ("points", "ratio", "nms", "threshold", "samples", "offsets"):
        assert [row.step for row in PAPER[name]] == [step.name for step in TABLES[name].steps]
    assert [row.step for row in SPARSE_RATIO] == [step.name for step in TABLES["ratio"].steps]
    with pytest.raises(ValueError, match="names of their own"):
        Series("x", "", "", (Step("a"), Step("a")))


@given(lines=st.lists(st.tuples(st.text(min_size=1, max_size=4), st.floats(0, 1)), max_size=5))
def test_a_journal_gives_back_what_was_written_whatever_was_torn(
    lines: list[tuple[str, float]], tmp_path_factory: pytest.TempPathFactory
) -> None:
    file = tmp_path_factory.mktemp("journal") / "points.jsonl"
    for name, value in lines:
        Journal(file).add(name, {"abs_rel": value})
        with file.open("a") as opened:
            opened.write('{"key": "half')  # killed while it wrote
    kept = Journal(file)
    for name, value in dict(lines).items():
        assert name in kept and kept[name] == {"abs_rel": value}
    assert "half" not in kept


def test_keys_differ_where_figures_may(capture: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    views = ViewSet("1", ("0", "2"))
    base = measuring.Measurement(capture, (views,), PredictConfig())
    series, step = TABLES["points"], TABLES["points"].steps[1]
    elsewhere = capture.frames.cam_from_world.copy()
    elsewhere[:, :3, 3] += 0.1
    arrays = capture.frames.arrays._replace(cam_from_world=elsewhere)
    others = [
        replace(base, capture=replace(capture, frames=Frames(capture.frames.folder, arrays))),
        replace(base, seed=1),
        replace(base, view_sets=(ViewSet("1", ("2", "0")),)),
        replace(base, predict=PredictConfig(work_size=(48, 64))),
    ]
    keys = {one.key(series, step, {"sha256": "a"}) for one in (base, *others)}
    keys |= {
        base.key(series, step, {"sha256": "b"}),
        base.key(series, TABLES["points"].steps[2], {"sha256": "a"}),
    }
    keys.add(base.key(TABLES["ratio"], step, {"sha256": "a"}))
    monkeypatch.setattr(measuring, "__version__", "of another day")
    keys.add(base.key(series, step, {"sha256": "a"}))
    assert len(keys) == 9 and key_of({"a": 1}) != key_of({"a": 2})


def test_a_table_that_was_stopped_goes_on_and_measures_nothing_twice(
    run: Run, tmp_path: Path, weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    where = write_capture(tmp_path / "walk", 4)
    command = ["ablate", "ratio", where, "--out", tmp_path / "out", "--weights", weights]
    evaluate, calls = measuring.evaluate_network, []

    def stopped(*arguments: object, **more: object) -> object:
        if len(calls) == 2:
            raise KeyboardInterrupt
        calls.append(1)
        return evaluate(*arguments, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(measuring, "evaluate_network", stopped)
    assert run(*command).code != 0 and not (tmp_path / "out" / "ratio.json").exists()

    def counted(*arguments: object, **more: object) -> object:
        calls.append(1)
        return evaluate(*arguments, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(measuring, "evaluate_network", counted)
    result = run(*command)
    assert result.code == 0 and len(calls) == 5, result.err
    assert run(*command).code == 0 and len(calls) == 5
    record = read_record(tmp_path / "out" / "ratio.json")
    shown = f"{weights.parent.name}/{weights.name}"
    own = [row for row in record.rows if row["weights"] == shown]
    assert list(record.weights) == [shown]
    assert str(tmp_path.parent) not in (tmp_path / "out" / "ratio.json").read_text()
    assert [row["step"] for row in own] == ["0", "0.25", "0.5", "0.75", "1"]
    assert all(row["abs_rel"] > 0 and row["sparse_abs_rel"] > 0 for row in own)
    told = [row for row in record.rows if row["weights"] == "the paper (ScanNet)"]
    assert told[1]["sparse_abs_rel"] == 0.0986
    assert (tmp_path / "out" / "ratio.png").stat().st_size > 5000


def test_a_method_in_the_networks_place_computes_where_it_would(
    capture: Capture, model: Deltas, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def loaded(name: str, device: str) -> None:
        asked.append((name, device))
        raise UserError("not installed", name, "install it")

    monkeypatch.setattr(measuring, "load_predictor", loaded)
    measurement = Measurement(capture, (ViewSet("0", ("1",)),), PredictConfig())
    for series in (TABLES["points"], TABLES["sparse"]):
        row = measuring._row(series, series.steps[-1], DeltasPredictor(model), measurement, "cuda")
        assert "not installed" in row["note"]
    assert asked == [("true-points", "cuda"), ("colmap-densified", "cuda")]


def test_maps_without_depth_are_no_figures_now_and_later(
    capture: Capture, weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def without(series: Series, step: Step, *_: object) -> dict[str, object]:
        first = step is series.steps[0]
        return {"step": step.name, "value": 0.0, "abs_rel": float("nan") if first else 0.1}

    monkeypatch.setattr(measuring, "_row", without)
    measurement = Measurement(capture, (ViewSet("0", ("1",)),), PredictConfig())
    many = TABLES["ratio"]
    for series, refused in ((many, False), (replace(many, steps=many.steps[:1]), True)):
        for _ in range(2):  # measured, and read back
            journal = Journal(tmp_path / f"{refused}.jsonl")
            if refused:
                with pytest.raises(UserError, match=r"nothing was measured .no map has depth"):
                    measuring.measure(series, [str(weights)], measurement, journal)
            else:
                found = measuring.measure(series, [str(weights)], measurement, journal)
                assert [row["abs_rel"] for row in found.rows] == [None, 0.1, 0.1, 0.1, 0.1]


def test_networks_whose_files_are_called_alike_are_told_apart(
    capture: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Stub:
        def weights_record(self, name: str) -> dict[str, str]:
            return {"name": name, "sha256": name}

    monkeypatch.setattr(measuring, "load_predictor", lambda *_: Stub())
    monkeypatch.setattr(measuring, "_row", lambda *_: {"abs_rel": 0.1})
    networks = ["/there/a/run/w.safetensors", "/there/b/run/w.safetensors", "deltas-small"]
    series = Series("one", "one", "", (Step("as it is"),))
    base = measuring.Measurement(capture, (ViewSet("1", ("0",)),), PredictConfig())
    found = measuring.measure(series, networks, base, Journal(tmp_path / "rows.jsonl"))
    shown = ["a/run/w.safetensors", "b/run/w.safetensors", "deltas-small"]
    assert [row["weights"] for row in found.rows] == shown == list(found.weights)
    assert [record["name"] for record in found.weights.values()] == shown


def test_nothing_is_written_among_the_files_of_a_capture(run: Run, tmp_path: Path) -> None:
    where = write_capture(tmp_path / "walk", 3)
    before = sorted(where.rglob("*"))
    for command in (["ablate", "nms"], ["robustness", "order"]):
        assert_one_line(run(*command, where, "--out", where), "is the capture itself", "--out")
        assert_one_line(run(*command, where, "--out", "o", "--weights"), "nothing is named")
    assert sorted(where.rglob("*")) == before


def test_what_a_network_lacks_is_said_by_name(run: Run, tmp_path: Path, weights: Path) -> None:
    where = write_capture(tmp_path / "walk", 3)
    common = [where, "--out", tmp_path / "out", "--weights", weights]
    assert_one_line(run("ablate", "offsets", *common), "nothing was measured", "leave it out")
    result = run("robustness", "views", *common, "--sets", 1)
    assert result.code == 0 and "no view set has 8 views" in result.out
    rows = read_record(tmp_path / "out" / "views.json").rows
    assert [row["step"] for row in rows if row.get("abs_rel")] == ["2", "3"]


def test_wrong_poses_are_scored_against_the_right_truth(
    run: Run, tmp_path: Path, weights: Path
) -> None:
    where = write_capture(tmp_path / "walk", 3)
    common = [where, "--out", tmp_path / "out", "--weights", weights, "--sets", 1]
    assert run("robustness", "calibration", *common).code == 0
    rows = read_record(tmp_path / "out" / "calibration.json").rows
    assert len({row["abs_rel"] for row in rows}) > 3 and rows[3]["step"] == "+0"
    assert_one_line(run("robustness", "calibration", *common[:3], "--sets", 0), "--sets 0")


def test_a_disturbed_network_keeps_its_disturbance_under_other_settings(model: Deltas) -> None:
    disturbed = Disturbed(DeltasPredictor(model), moved(0.1, 0))
    other = disturbed.varied(NetworkSettings(num_points=16))
    assert other.change is disturbed.change
    unit = InUnit(DeltasPredictor(model), 3.0, told=True).varied(NetworkSettings(num_points=16))
    assert (unit.factor, unit.told) == (3.0, True)


def test_the_cost_of_a_network_is_not_said_of_a_part_of_it(model: Deltas) -> None:
    assert measuring._cost(DeltasPredictor(model, without_points=True)) == {}


def test_the_published_checkpoint_has_the_settings_that_ours_lacks(
    run: Run, tmp_path: Path, weights: Path
) -> None:
    where = write_capture(tmp_path / "walk", 3)
    file = tmp_path / "checkpoint.pth.tar"
    torch.save(random_tables(), file)
    common = [where, "--out", tmp_path / "out", "--sets", 1, "--work-size", 48, 64]
    result = run("ablate", "offsets", *common, "--weights", file)
    assert result.code == 0, result.err
    rows = read_record(tmp_path / "out" / "offsets.json").rows
    own = [row for row in rows if row["weights"] != "the paper (ScanNet)"]
    assert [row["step"] for row in own] == ["1", "2"] and all(row["frames"] == 1 for row in own)
    assert run("ablate", "architecture", *common, "--weights", weights).code == 0
    row = read_record(tmp_path / "out" / "architecture.json").rows[0]
    assert 2 < row["gmacs"] < 8 and row["parameters"] > 1e6


def test_a_figure_has_a_mark_for_every_row_that_was_measured(tmp_path: Path) -> None:
    for name in ("points", "architecture", "sparse"):
        series = TABLES[name]
        rows = with_paper(series, [])
        draw_series(tmp_path / "all.png", series, rows)
        draw_series(tmp_path / "none.png", series, [])
        pictures = [
            np.asarray(Image.open(tmp_path / f"{n}.png").convert("RGB")) for n in ("all", "none")
        ]
        # Orange and blue are the colours of marks and bars.
        coloured = [np.ptp(picture.astype(int), axis=-1) > 100 for picture in pictures]
        assert coloured[0].sum() > 150 and coloured[1].sum() == 0
