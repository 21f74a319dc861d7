"""What is not exported: a file that gives another depth, and nonsense."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from exported_depth import needs_extra, room
from run_command import Run, assert_one_line
from torch import Tensor

from deltas_nets.config import DetectorConfig, MatcherConfig, NetworkConfig
from deltas_nets.errors import UserError
from deltas_nets.export import OUTPUTS, ExportConfig, export_onnx, export_program, formats
from deltas_nets.export.agreement import Inputs, RunExported, check_agreement, same_points
from deltas_nets.export.formats import onnx_bytes
from deltas_nets.export.graph import FixedDeltas
from deltas_nets.network.deltas import Deltas


@pytest.fixture(scope="module")
def untrained() -> Deltas:
    torch.manual_seed(0)
    detector, matcher = DetectorConfig(num_keypoints=32), MatcherConfig(num_samples=16)
    return Deltas(NetworkConfig(detector=detector, matcher=matcher)).eval()


def of(model: Deltas, change: Callable[[int, dict[str, Tensor]], dict[str, Tensor]]) -> RunExported:
    """A network that gives what ``model`` gives, changed by the number of the call."""
    calls = iter(range(10))

    def run(inputs: Inputs) -> dict[str, Tensor]:
        with torch.no_grad():
            found = FixedDeltas(model, SMALL).eval()(*inputs)
        return change(next(calls), found)

    return run


SMALL = ExportConfig(2, 32, (48, 64))


def test_a_depth_that_differs_at_one_pixel_is_refused(untrained: Deltas) -> None:
    def spoilt(_: int, found: dict[str, Tensor]) -> dict[str, Tensor]:
        found["depth"][0, 0, 7, 9] *= 1.002
        return found

    def unknown(_: int, found: dict[str, Tensor]) -> dict[str, Tensor]:
        found["depth"][0, 0, 7, 9] = torch.nan
        return found

    for change in (spoilt, unknown):
        with pytest.raises(UserError, match=r"it gives a depth that differs by .*, x\.onnx"):
            check_agreement(
                of(untrained, change), untrained, SMALL, runtime="it", out=Path("x.onnx")
            )


def test_a_tie_of_detections_is_no_difference_but_three_are(untrained: Deltas) -> None:
    def other_points(call: int, found: dict[str, Tensor]) -> dict[str, Tensor]:
        moved = found["keypoints"].clone()
        moved[0, 0] += 1
        tied = {"keypoints": moved, "depth": 2 * found["depth"]}
        return {**found, **tied} if call < ties else found

    ties = 1
    found = check_agreement(
        of(untrained, other_points), untrained, SMALL, runtime="it", out=Path("x.onnx")
    )
    assert found.relative == 0 and found.room == 902
    ties = 3
    with pytest.raises(UserError, match="it detects other points in 3 rooms"):
        check_agreement(
            of(untrained, other_points), untrained, SMALL, runtime="it", out=Path("x.onnx")
        )


def test_keypoints_are_the_same_in_any_order() -> None:
    points = torch.tensor([[[1.0, 2], [3, 4], [3, 4]]])
    assert same_points(points, points[:, [2, 0, 1]])
    assert not same_points(points, torch.tensor([[[1.0, 2], [1, 2], [3, 4]]]))
    assert not same_points(points, points + 1)


def test_nothing_is_written_where_the_depth_differs(
    untrained: Deltas, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    needs_extra()

    def wrong(_: bytes) -> RunExported:
        return of(untrained, lambda _, found: {**found, "depth": 2 * found["depth"]})

    monkeypatch.setattr(formats, "onnx_runner", wrong)
    monkeypatch.setattr(formats, "onnx_bytes", lambda *_: b"")
    monkeypatch.setattr(formats, "trace", lambda *_: None)
    with pytest.raises(UserError, match="nothing was written"):
        export_onnx(untrained, tmp_path / "x.onnx", SMALL)
    assert list(tmp_path.iterdir()) == []


def test_no_region_without_gradients_lies_in_another(
    untrained: Deltas, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A program is traced in pieces at each of them, which takes twice as long.
    inputs = room(1, SMALL)
    with torch.no_grad():
        monkeypatch.setattr(torch, "no_grad", lambda: pytest.fail("gradients are off already"))
        FixedDeltas(untrained, SMALL)(*inputs)


def test_what_onnx_cannot_say_is_an_error_in_a_line() -> None:
    needs_extra()

    class Eigenvalues(torch.nn.Module):
        def forward(self, matrix: Tensor) -> dict[str, Tensor]:
            return {name: torch.linalg.eigvalsh(matrix) for name in OUTPUTS}

    program = torch.export.export(Eigenvalues(), (torch.eye(3),))
    with pytest.raises(UserError, match=r"cannot be expressed in ONNX .*x\.onnx: export a \.pt2"):
        onnx_bytes(program, {}, Path("x.onnx"))


def test_a_network_in_training_is_not_exported(untrained: Deltas, tmp_path: Path) -> None:
    untrained.train()
    try:
        with pytest.raises(ValueError, match=r"call model\.eval\(\)"):
            export_program(untrained, tmp_path / "x.pt2", SMALL)
    finally:
        untrained.eval()


@pytest.mark.parametrize(
    "wrong",
    [
        {"num_views": 1},
        {"num_points": 7},
        {"image_size": (31, 64)},
        {"depth_range": (2.0, 1.0)},
        {"refinement": 0},
    ],
    ids=lambda wrong: next(iter(wrong)),
)
def test_nonsense_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="must be"):
        ExportConfig(**wrong)  # type: ignore[arg-type]


def test_the_command_refuses_in_one_line(run: Run, tmp_path: Path) -> None:
    there = tmp_path / "there.onnx"
    there.write_bytes(b"mine")
    out = tmp_path / "x.onnx"
    assert_one_line(run("export", "--out", tmp_path / "x.bin"), "x.bin", "use .onnx or .pt2")
    assert_one_line(run("export", "--out", there), "the file exists", "--overwrite")
    assert there.read_bytes() == b"mine"
    assert_one_line(run("export", "--out", out, "--views", 1), "2 views or more")
    assert_one_line(run("export", "--out", out, "--size", 8, 8), "--size 8 8", "32 or more")
    assert_one_line(run("export", "--out", out, "--depth-range", 3, 1), "NEAR < FAR")
    assert_one_line(run("export", "--out", out, "--weights", "nothing"), "no such weights")
    assert_one_line(
        run("export", "--out", out, "--weights", "plane-sweep"), "plane-sweep: name del"
    )
    small = ["export", "--out", out, "--size", 32, 32]
    assert_one_line(run(*small, "--points", 10**6), "fewer pixels than points", "--points 1000000")
    assert_one_line(run(*small, "--points", 7), "--points 7: use 8 or more")
    assert_one_line(run(*small, "--refinement", 0), "--refinement 0: use 1 or more")
    assert_one_line(run("export"), "--out", "see deltas export --help")
    assert not out.exists()


def test_the_command_names_the_extra_that_is_missing(
    run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    result = run("export", "--out", tmp_path / "x.onnx")
    assert_one_line(result, "onnxruntime", 'pip install "deltas-depth[export]"')
    assert list(tmp_path.iterdir()) == []
