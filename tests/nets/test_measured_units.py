"""Depths measured by hand that are hardly in metres, and files of them that name no frame."""

from dataclasses import replace
from pathlib import Path

import pytest
from conftest import MakeCapture
from test_search import Oracle

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.measured import doubtful_unit, measured_by_hand
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.scaled import scaled
from deltas_nets.commands.measuring import Measuring
from deltas_nets.errors import UserError
from deltas_nets.predict.depth_map import PredictConfig
from deltas_nets.predict.first_look import scale_by_measurements


def measured(folder: Path, *depths: float) -> Path:
    file = folder / "measured.txt"
    file.write_text("".join(f"{id} 10 20 {depth}\n" for id, depth in enumerate(depths)))
    return file


@pytest.mark.parametrize(
    ("factor", "doubted"), [(0.2, False), (1, False), (5, False), (100, True), (1000, True)]
)
def test_centimetres_and_millimetres_are_doubted(
    factor: float,
    doubted: bool,
    capture: Capture,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = measured(tmp_path, 2.5 * factor, 2.4 * factor, 9 * factor)
    Measuring(sensor_depth=file).measured(capture)
    said = capsys.readouterr().err
    assert ("are they in metres?" in said and str(file) in said) is doubted


@pytest.mark.parametrize("metres", [0.004, 300.0])
def test_what_is_as_far_as_cameras_are_apart_is_not_doubted(
    metres: float, make_capture: MakeCapture, tmp_path: Path
) -> None:
    capture = open_capture(make_capture(step=metres / 5))
    assert doubtful_unit(measured_by_hand(measured(tmp_path, metres), capture), capture) is None


def test_a_frame_that_there_is_not_is_named_with_file_and_line(
    capture: Capture, tmp_path: Path
) -> None:
    file = tmp_path / "measured.txt"
    file.write_text("# tape\n1 10 20 2.5\n77 10 20 2.5\n")
    with pytest.raises(UserError, match="line 3: the capture has no frame 77") as raised:
        measured_by_hand(file, capture)
    assert raised.value.where == file and "nearest" in raised.value.remedy


@pytest.mark.parametrize(
    ("metric", "unit", "doubted"), [(True, 1.2, False), (True, 1000, True), (False, 1000, False)]
)
def test_metres_that_measurements_make_another_size_are_doubted(
    metric: bool,
    unit: float,
    doubted: bool,
    capture: Capture,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    seen = replace(scaled(capture, 1.0), metric=metric)
    file = measured(tmp_path, 2.5 * unit)
    config = PredictConfig()
    found = scale_by_measurements(Oracle(2.5), seen, config, file)  # type: ignore[arg-type]
    assert found == pytest.approx(unit)
    assert ("in metres already" in capsys.readouterr().err) is doubted
