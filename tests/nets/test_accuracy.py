"""Accuracy of the shipped weights on a real capture, also by an independent scorer."""

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType

import pytest

from deltas_nets import cli, load_model
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.view_choice import choose_view_sets
from deltas_nets.captures.view_sets import read_view_sets
from deltas_nets.evaluate.capture import evaluate_network
from deltas_nets.evaluate.scores import CaptureScores
from deltas_nets.predict.depth_map import PredictConfig
from deltas_nets.predict.ours import DeltasPredictor

pytestmark = pytest.mark.shared
Factory = pytest.TempPathFactory
NAMES = ("abs_rel", "abs_diff", "sq_rel", "rmse", "rmse_log", "delta1", "delta2", "delta3")
NAMES += ("coverage",)


@pytest.fixture(scope="module")
def hololens(shared_data: Path) -> Path:
    return shared_data / "hololens"


@pytest.fixture(scope="module", params=[4, pytest.param(1, marks=pytest.mark.slow)])
def sets(hololens: Path, request: pytest.FixtureRequest, tmp_path_factory: Factory) -> Path:
    """Every fourth view set of the capture, or, at night, every one."""
    file = tmp_path_factory.mktemp("sets") / "view_sets.json"
    every = json.loads((hololens / "view_sets.json").read_text())
    file.write_text(json.dumps(every[:: request.param]))
    (file.parent / "depth").symlink_to(hololens / "depth")  # where the independent scorer looks
    return file


@pytest.fixture(scope="module")
def alone(hololens: Path, sets: Path) -> dict[int, CaptureScores]:
    """Of the network alone, by the number of views: its maps hear no others."""
    capture, model = open_capture(hololens), load_model()
    found = {}
    for views in (3, 7):
        whole = read_view_sets(sets, capture)
        view_sets = tuple(v._replace(sources=v.sources[: views - 1]) for v in whole)
        found[views] = evaluate_network(DeltasPredictor(model), capture, view_sets, PredictConfig())
    return found


@pytest.fixture(scope="module")
def three_views(hololens: Path, sets: Path, tmp_path_factory: Factory) -> Path:
    """The folder that `deltas depth` fills."""
    out = tmp_path_factory.mktemp("hololens") / "out"
    arguments = ["depth", hololens, "--out", out, "--view-sets", sets, "--views", 3]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["deltas", *map(str, arguments)])
        cli.main()
    return out


@pytest.fixture(scope="module")
def scored(hololens: Path, sets: Path, three_views: Path, tmp_path_factory: Factory) -> dict:
    """What `deltas evaluate` writes of that folder."""
    file = tmp_path_factory.mktemp("scores") / "scores.json"
    arguments = ["evaluate", hololens, "--view-sets", sets]
    arguments += ["--predictions", three_views, "--json", file]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["deltas", *map(str, arguments)])
        cli.main()
    written: dict = json.loads(file.read_text())
    return written


@pytest.fixture(scope="module")
def scores(scored: dict) -> dict:
    metrics: dict = scored["metrics"]
    return metrics


@pytest.fixture(scope="module")
def scorer(shared_data: Path) -> ModuleType:
    """A program that shares nothing with this one, as a module."""
    file = shared_data.parent / "tools" / "score_depth.py"
    if not file.is_file():
        pytest.skip(f"needs {file}")
    spec = importlib.util.spec_from_file_location("score_depth", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_three_views_are_accurate_and_complete(scores: dict) -> None:
    assert scores["dense"]["abs_rel"] <= 0.080
    assert scores["dense"]["delta1"] >= 0.925
    assert scores["dense"]["coverage"] >= 0.99


def test_seven_views_are_better(alone: dict[int, CaptureScores]) -> None:
    three, seven = alone[3].dense, alone[7].dense
    assert seven.abs_rel < three.abs_rel and seven.delta1 > three.delta1
    assert seven.abs_rel <= 0.065
    assert seven.delta1 >= 0.935


def test_an_independent_scorer_agrees_on_every_frame_to_a_millionth(
    sets: Path, three_views: Path, scored: dict, scorer: ModuleType
) -> None:
    ids, raw, scaled = scorer.score(str(sets.parent), str(three_views / "depth"))
    frames = {row["frame"]: row for row in scored["frames"]}
    assert [str(id) for id in ids] == list(frames)
    for prefix, expected in (("", raw), ("median_", scaled)):
        for row, values in zip(frames.values(), expected, strict=True):
            ours = [row[prefix + name] for name in NAMES]
            assert ours == pytest.approx(values.tolist(), abs=1e-6)


def test_views_chosen_by_ourselves_do_as_well(hololens: Path, sets: Path, scores: dict) -> None:
    capture = open_capture(hololens)
    anchors = [views.anchor for views in read_view_sets(sets, capture)]
    chosen = choose_view_sets(capture, 3, anchors=anchors)
    found = evaluate_network(DeltasPredictor(load_model()), capture, chosen, PredictConfig())
    assert found.dense.abs_rel < 1.25 * scores["dense"]["abs_rel"]
