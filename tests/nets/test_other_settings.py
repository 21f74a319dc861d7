"""What is said of a run that would go on with other settings."""

from pathlib import Path
from typing import Any

import pytest
from conftest import MakeCapture
from run_command import Run, assert_one_line

from deltas_nets.commands import depth as command
from deltas_nets.commands.depth_folder import check_settings
from deltas_nets.commands.measuring import MEASURED
from deltas_nets.errors import UserError
from deltas_nets.outputs.prepare import prepare_output
from deltas_nets.outputs.products import OutputOptions
from deltas_nets.outputs.summary import FORMAT


def prepare(out: Path, scaled_by: float, cameras: str) -> None:
    prepare_output(
        out,
        settings={"capture": {"cameras": cameras}, "view_sets": [[cameras, []]]},
        overwrite=False,
        shard=(1, 1),
        frame_ids=["0"],
        options=OutputOptions(),
        head={"scaled_by": scaled_by},
    )


@pytest.mark.parametrize(("scale", "named"), [(2.0, True), (1.0, False)])
def test_another_scale_is_named_by_its_flag(tmp_path: Path, scale: float, named: bool) -> None:
    prepare(tmp_path / "out", 1.0, "of before")
    with pytest.raises(UserError, match="other settings") as raised:
        prepare(tmp_path / "out", scale, "of now")
    assert ("--scale or --scale-from was 1, is 2" in raised.value.what) is named


@pytest.fixture
def begun(
    make_capture: MakeCapture, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> tuple[object, ...]:
    """A command whose folder an earlier run filled; a look at images ends it with a word."""
    seen: list[Any] = []

    def look(*_: object) -> None:
        raise UserError("looked", "at images", "be quicker")

    with monkeypatch.context() as patch:
        patch.setattr(command, "check_settings", lambda _, asked, *__, **___: seen.append(asked))
        patch.setattr(command, "look_first", look)
        words = ("depth", make_capture(), "--out", tmp_path / "out", "--weights", "plane-sweep")
        run(*words)
    prepare_output(tmp_path / "out", settings=seen[0] | {"view_sets": [], "depth_scale": 1000.0})
    monkeypatch.setattr(command, "look_first", look)
    return words


@pytest.mark.parametrize(
    ("asked", "named"),
    [
        (("--views", 4), "--views was null, is 4"),
        (("--passes", 1), "--passes was 3, is 1"),
        (("--format", "npz"), '--format was null, is "npz"'),
        (("--min-confidence", 0.5), "--min-confidence was 0.0, is 0.5"),
        (("--depth-range", 1, 2), "--depth-range"),
        (("--intrinsics", "60 60 31.5 23.5"), "the capture or one of its cameras"),
        (("--weights", "no-points"), "--weights"),
    ],
)
def test_other_settings_are_told_before_anything_is_looked_at(
    begun: tuple[object, ...], run: Run, asked: tuple[object, ...], named: str
) -> None:
    assert_one_line(run(*begun, *asked), "an earlier run had other settings", named)
    said = run(*begun, *asked, "--overwrite")
    assert "looked" in said.err


@pytest.mark.parametrize(("name", "value"), [(MEASURED, "measured.txt"), (FORMAT, "npz")])
def test_what_an_earlier_run_alone_was_asked_for_is_told(
    tmp_path: Path, name: str, value: str
) -> None:
    prepare_output(tmp_path, settings={"predict": {}, name: value})
    with pytest.raises(UserError, match="other settings"):
        check_settings(tmp_path, {"predict": {}}, None, overwrite=False)


def test_the_same_settings_go_on(begun: tuple[object, ...], run: Run) -> None:
    assert "looked" in run(*begun).err


def test_a_wrong_line_of_measured_depth_is_told_before_anything_is_looked_at(
    begun: tuple[object, ...], run: Run, tmp_path: Path
) -> None:
    file = tmp_path / "measured.txt"
    file.write_text("0 3 4 1.5\n0 300 4 1.5\n")
    words = (*begun[:-1], "deltas-small", "--overwrite", "--sensor-depth", file)
    assert_one_line(run(*words), "line 2: pixel (300, 4) is outside of frame 0")
    assert_one_line(run(*words, "--scale-from", file), "line 2: pixel (300, 4)")


def test_wrong_view_sets_and_steps_are_told_before_anything_is_looked_at(
    begun: tuple[object, ...], run: Run, tmp_path: Path
) -> None:
    sets = tmp_path / "view_sets.json"
    sets.write_text('[{"anchor": 77, "sources": [0]}]')
    words = (*begun, "--overwrite")
    assert_one_line(run(*words, "--view-sets", sets), "77")
    assert_one_line(run(*words, "--depth-range", 1, 1000), "--depth-scale")
    assert "looked" in run(*words, "--depth-range", 1, 1000, "--format", "npz").err
