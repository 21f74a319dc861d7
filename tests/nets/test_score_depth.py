"""The metrics are those of a program that shares nothing with this one."""

import importlib.util
import json
from pathlib import Path
from types import ModuleType

import pytest
from run_command import Run

pytestmark = pytest.mark.shared
NAMES = ("abs_rel", "abs_diff", "sq_rel", "rmse", "rmse_log", "delta1", "delta2", "delta3")
NAMES += ("coverage",)


@pytest.fixture(scope="module")
def scorer(shared_data: Path) -> ModuleType:
    """The independent program, as a module."""
    file = shared_data.parent / "tools" / "score_depth.py"
    if not file.is_file():
        pytest.skip(f"needs {file}")
    spec = importlib.util.spec_from_file_location("score_depth", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("every", [9, pytest.param(1, marks=pytest.mark.slow)])
def test_they_agree_on_every_frame_to_a_millionth(
    every: int, run: Run, scorer: ModuleType, shared_data: Path, tmp_path: Path
) -> None:
    capture, sets = shared_data / "hololens", tmp_path / "view_sets.json"
    listed = json.loads((capture / "view_sets.json").read_text())
    sets.write_text(json.dumps(listed[::every]))
    (tmp_path / "depth").symlink_to(capture / "depth")  # where the other looks for the truth
    out, file = tmp_path / "out", tmp_path / "scores.json"
    asked = ["--view-sets", sets, "--views", 3]
    maps = ["--no-page", "--passes", 1, "--depth-range", 0.5, 10]
    assert run("depth", capture, "--out", out, *asked, *maps).code == 0
    told = run("evaluate", capture, "--predictions", out, "--json", file)
    assert told.code == 0, told.err
    ids, raw, scaled = scorer.score(str(tmp_path), str(out / "depth"))
    frames = {row["frame"]: row for row in json.loads(file.read_text())["frames"]}
    assert [str(id) for id in ids] == list(frames)
    for prefix, expected in (("", raw), ("median_", scaled)):
        for row, values in zip(frames.values(), expected, strict=True):
            ours = [row[prefix + name] for name in NAMES]
            assert ours == pytest.approx(values.tolist(), abs=1e-6)
