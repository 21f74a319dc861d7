"""The demo on the real pair, with the shipped weights: what the README promises."""

import json
import sys
from pathlib import Path

import pytest
from PIL import Image

from deltas_nets import cli


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("demo") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["deltas", "demo", "--out", str(out)])
        cli.main()
    return out


def test_the_pair_comes_out_metric(demo: Path) -> None:
    frame = json.loads((demo / "summary.json").read_text())["frames"]["left"]
    assert frame["dense"]["abs_rel"] <= 0.10
    assert frame["dense"]["delta1"] >= 0.90
    assert frame["dense"]["coverage"] >= 0.99
    assert frame["sparse"]["median_relative_error"] <= 0.03


def test_everything_is_written_and_nothing_else(demo: Path) -> None:
    files = sorted(str(path.relative_to(demo)) for path in demo.rglob("*") if path.is_file())
    assert files == [
        "confidence/left.png",
        "demo.png",
        "depth/left.png",
        "points/left.ply",
        "summary.json",
    ]
    with Image.open(demo / "depth" / "left.png") as image:
        assert image.size == (741, 500)


def test_every_stage_has_a_time(demo: Path) -> None:
    stages = json.loads((demo / "summary.json").read_text())["frames"]["left"]["stages"]
    assert set(stages) == {
        "encoder",
        "detector",
        "descriptor",
        "matcher",
        "triangulation and sparse depth",
        "densifier",
        "total",
    }
    parts = sum(seconds for name, seconds in stages.items() if name != "total")
    assert parts == pytest.approx(stages["total"], abs=0.01)
    assert all(seconds >= 0 for seconds in stages.values())


def test_the_demo_can_be_repeated(demo: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["deltas", "demo", "--out", str(demo)])
    cli.main()
    assert (demo / "demo.png").stat().st_size > 50_000
