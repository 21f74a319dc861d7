"""Measured depths that are hardly in metres, and files of them that name no frame."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import MakeCapture
from test_search import Oracle

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.measured import OfSensor, doubtful_unit, measured_by_hand
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.scaled import scaled
from deltas_nets.commands.measuring import Measuring
from deltas_nets.errors import UserError
from deltas_nets.outputs.verdict import verdict
from deltas_nets.predict.depth_map import DepthMap, KeypointDepths, PredictConfig, Wanted
from deltas_nets.predict.first_look import scale_by_measurements
from deltas_nets.predict.look import look
from deltas_nets.predict.reach import ROOM, Reach


class Spread(Oracle):
    """Triangulates points all over the image, a few of them wrong."""

    def depth_map(self, wanted: Wanted) -> DepthMap:
        found = super().depth_map(wanted)
        height, width = 240, 320
        places = np.random.default_rng(0).uniform((0, 0), (width - 1, height - 1), (300, 2))
        depth = torch.full((300,), float(found.keypoints.depth[0]))
        depth[::7], depth[::9] = 0, 9.0
        keypoints = KeypointDepths(torch.from_numpy(places).float(), depth, (height, width))
        return found._replace(keypoints=keypoints)


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


@pytest.mark.parametrize("factor", [0.1, 1.0, 5.0, 30.0])
@pytest.mark.parametrize("unit", [1.0, 7.0])
def test_a_map_knows_how_much_farther_things_were_measured_than_triangulated(
    factor: float, unit: float, capture: Capture
) -> None:
    frames = [replace(frame, depth_scale=1000 / factor) for frame in capture.frames.values()]
    wrong = replace(capture, frames=type(capture.frames).of(frames, capture.path))
    known, reach = OfSensor(wrong, 0.01)(1), Reach(*ROOM, unit=unit)
    config, oracle = PredictConfig(), Spread(2.5)
    found = look(oracle, frames[1:], config, reach, known)  # type: ignore[arg-type]
    assert found.measured_factor == pytest.approx(factor, rel=1e-4)
    assert look(oracle, frames[1:], config, reach).measured_factor is None  # type: ignore[arg-type]


def test_a_few_measured_depths_are_no_reason_to_doubt_them(capture: Capture) -> None:
    frames, known = list(capture.frames.values()), OfSensor(capture, 0.01)(1)
    assert known is not None
    few = known._replace(pixels=known.pixels[:4], depth=9 * known.depth[:4])
    found = look(Spread(2.5), frames[1:], PredictConfig(), Reach(*ROOM, unit=1.0), few)  # type: ignore[arg-type]
    assert found.measured_factor is None


@pytest.mark.parametrize(("factor", "doubted"), [(0.2, True), (0.9, False), (5.04, True)])
def test_a_verdict_doubts_measured_depth_of_another_unit(factor: float, doubted: bool) -> None:
    sure = {"confidence": 0.92, "valid_points": 700, "keypoints": 768}
    said = verdict([sure | {"measured_factor": factor}] * 2 + [sure | {"measured_factor": 1.0}])
    assert said.doubtful is doubted
    assert (f"measured depth is {factor} times as far" in said.line) is doubted
    assert not verdict([sure]).doubtful
