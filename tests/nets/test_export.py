"""Exported networks give the depth of the network, whatever images and cameras they get."""

import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest
import torch
from run_command import Run, assert_one_line, runner
from torch import Tensor

from deltas_nets.config import CONFIGS, DetectorConfig, MatcherConfig, NetworkConfig
from deltas_nets.data.synthetic import render_room
from deltas_nets.errors import UserError
from deltas_nets.export import OUTPUTS, ExportConfig, export_onnx, export_program, formats
from deltas_nets.export.agreement import (
    TOLERANCE,
    Inputs,
    RunExported,
    check_agreement,
    inputs_of,
    relative_difference,
    same_points,
)
from deltas_nets.export.formats import (
    metadata_of,
    onnx_bytes,
    onnx_runner,
    program_bytes,
    program_runner,
)
from deltas_nets.export.graph import FixedDeltas, trace
from deltas_nets.network.deltas import Deltas
from deltas_nets.pretrained import load_model

SIZE = (64, 96)
CPU = torch.device("cpu")


class Exported(NamedTuple):
    """A network of so many views, and what it became."""

    model: Deltas
    config: ExportConfig
    onnx: bytes
    onnx_run: RunExported
    program: bytes
    program_run: RunExported

    def eager(self, inputs: Inputs) -> dict[str, Tensor]:
        with torch.no_grad():
            found: dict[str, Tensor] = FixedDeltas(self.model, self.config).eval()(*inputs)
        return found


# Each takes most of a minute to export. The example of export_onnx compares 2 views every time.
@pytest.fixture(
    scope="module",
    params=[
        pytest.param(3, id="3 views"),
        pytest.param(2, id="2 views", marks=pytest.mark.slow),
    ],
)
def exported(request: pytest.FixtureRequest) -> Exported:
    needs_extra()
    model, config = load_model(), ExportConfig(request.param, 64, SIZE)
    program, metadata = trace(model, config), metadata_of(model, config, {"step": "7"})
    onnx, saved = onnx_bytes(program, metadata, Path("x.onnx")), program_bytes(program, metadata)
    return Exported(model, config, onnx, onnx_runner(onnx), saved, program_runner(saved, CPU))


def needs_extra() -> None:
    for package in ("onnx", "onnxscript", "onnxruntime"):
        pytest.importorskip(package, reason="needs the extra 'export'")


def room(seed: int, config: ExportConfig) -> Inputs:
    return inputs_of(render_room(seed, num_views=config.num_views, image_size=config.image_size))


def assert_same_depth(found: dict[str, Tensor], wanted: dict[str, Tensor]) -> None:
    assert relative_difference(found["depth"], wanted["depth"]) < TOLERANCE
    # An estimate of an error: two digits of it are more than it is good for.
    assert relative_difference(found["std"], wanted["std"]) < 0.01


def test_shapes_are_as_documented(exported: Exported) -> None:
    shapes = {
        "depth": (1, 1, *SIZE),
        "std": (1, 1, *SIZE),
        "keypoints": (1, 64, 2),
        "points": (1, 64, 3),
    }
    for run in (exported.onnx_run, exported.program_run):
        found = run(room(1, exported.config))
        assert {name: tuple(tensor.shape) for name, tensor in found.items()} == shapes


def test_other_rooms_and_cameras_give_the_networks_depth(exported: Exported) -> None:
    depths: list[Tensor] = []
    for seed in range(20, 26):
        inputs = room(seed, exported.config)
        wanted = exported.eager(inputs)
        found = exported.onnx_run(inputs)
        if not same_points(found["keypoints"], wanted["keypoints"]):
            continue  # a tie of two detections, which rounding decides
        assert_same_depth(found, wanted)
        assert_same_depth(exported.program_run(inputs), wanted)
        depths.append(wanted["depth"])
    assert len(depths) >= 3
    # No two rooms look alike to it: nothing of one was kept for another.
    assert relative_difference(depths[0], depths[1]) > 0.1
    assert relative_difference(depths[1], depths[2]) > 0.1


def opposite(inputs: Inputs) -> Inputs:
    """The last source looks away: every point is behind it."""
    images, K, poses = inputs
    poses = poses.clone()
    poses[0, -1] = torch.diag(torch.tensor([-1.0, 1, -1, 1])) @ poses[0, -1]
    return images, K, poses


def aside(inputs: Inputs) -> Inputs:
    """The last source looks 60 degrees to the right: some points are outside, some behind."""
    images, K, poses = inputs
    poses = poses.clone()
    turn = torch.eye(4)
    turn[0, 0], turn[0, 2], turn[2, 0], turn[2, 2] = 0.5, -(0.75**0.5), 0.75**0.5, 0.5
    poses[0, -1] = turn @ poses[0, -1]
    return images, K, poses


def no_baseline(inputs: Inputs) -> Inputs:
    """All cameras stand in one place."""
    images, K, poses = inputs
    return images, K, poses[:, :1].expand_as(poses).contiguous()


def narrow(inputs: Inputs) -> Inputs:
    """Twice the focal length, and the world's origin is elsewhere."""
    images, K, poses = inputs
    K, poses = K.clone(), poses.clone()
    K[..., :2, :2] *= 2
    poses[..., :3, 3:] += poses[..., :3, :3] @ torch.tensor([[3.0], [-2.0], [5.0]])
    return images, K, poses


def lost(inputs: Inputs) -> Inputs:
    """The last source has no pose."""
    images, K, poses = inputs
    poses = poses.clone()
    poses[0, -1] = torch.nan
    return images, K, poses


@pytest.mark.parametrize("change", [opposite, aside, no_baseline, narrow, lost])
def test_hard_cameras_give_the_networks_depth(
    exported: Exported, change: Callable[[Inputs], Inputs]
) -> None:
    compared = 0
    for seed in range(20, 23):
        inputs = change(room(seed, exported.config))
        wanted, found = exported.eager(inputs), exported.onnx_run(inputs)
        assert wanted["depth"].isfinite().all()
        if same_points(found["keypoints"], wanted["keypoints"]):
            assert_same_depth(found, wanted)
            assert_same_depth(exported.program_run(inputs), wanted)
            compared += 1
    assert compared > 0


def test_points_that_are_not_found_are_zero_in_the_file_too(exported: Exported) -> None:
    inputs = no_baseline(room(20, exported.config))
    for run in (exported.onnx_run, exported.program_run):
        assert (run(inputs)["points"] == 0).all()
    seen = exported.onnx_run(room(20, exported.config))
    assert (seen["points"] != 0).any(-1).float().mean() > 0.5


def test_an_onnx_file_needs_onnxruntime_alone_and_tells_what_it_is(
    exported: Exported, tmp_path: Path
) -> None:
    (tmp_path / "x.onnx").write_bytes(exported.onnx)
    code = """
import json, sys
for name in ("torch", "deltas_nets", "deltas_geom", "onnx"):
    sys.modules[name] = None
import numpy, onnxruntime
session = onnxruntime.InferenceSession("x.onnx", providers=["CPUExecutionProvider"])
fed = {known.name: numpy.zeros(known.shape, numpy.float32) for known in session.get_inputs()}
fed["K"][:] = [[60, 0, 48], [0, 60, 32], [0, 0, 1]]
fed["cam_from_world"][:] = numpy.eye(4)
fed["cam_from_world"][0, 1, 0, 3] = -0.1
depth = session.run(["depth"], fed)[0]
assert numpy.isfinite(depth).all() and (depth > 0).all()
print(json.dumps(session.get_modelmeta().custom_metadata_map))
"""
    metadata = json.loads(python(code, tmp_path))
    assert_tells_what_it_is(metadata, exported)


def test_a_program_needs_torch_alone_and_tells_what_it_is(
    exported: Exported, tmp_path: Path
) -> None:
    (tmp_path / "x.pt2").write_bytes(exported.program)
    code = """
import sys
for name in ("deltas_nets", "deltas_geom"):
    sys.modules[name] = None
import torch
extra = {"deltas.json": ""}
run = torch.export.load("x.pt2", extra_files=extra).module()
views = int(sys.argv[1])
K = torch.tensor([[60.0, 0, 48], [0, 60, 32], [0, 0, 1]]).repeat(1, views, 1, 1)
poses = torch.eye(4).repeat(1, views, 1, 1)
poses[0, 1, 0, 3] = -0.1
depth = run(torch.zeros(1, views, 3, 64, 96), K, poses)["depth"]
assert depth.isfinite().all() and (depth > 0).all()
print(extra["deltas.json"])
"""
    metadata = json.loads(python(code, tmp_path, str(exported.config.num_views)))
    assert_tells_what_it_is(metadata, exported)


def python(code: str, folder: Path, *arguments: str) -> str:
    command = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def assert_tells_what_it_is(metadata: dict[str, str], exported: Exported) -> None:
    known = {name: json.loads(value) for name, value in metadata.items()}
    assert known["network"]["name"] == "deltas-small"
    assert known["depth_range"] == [0.5, 10.0]
    assert known["export"]["num_views"] == exported.config.num_views
    assert known["export"]["image_size"] == list(SIZE)
    assert known["weights"]["step"] == "7"
    assert len(known["weights"]["parameters_sha256"]) == 64
    assert known["versions"]["torch"] == torch.__version__


def test_the_fingerprint_is_of_every_weight() -> None:
    model = Deltas(NetworkConfig())
    before = metadata_of(model, ExportConfig())["weights"]
    assert metadata_of(model, ExportConfig())["weights"] == before
    with torch.no_grad():
        next(reversed(list(model.parameters()))).add_(1e-6)
    assert metadata_of(model, ExportConfig())["weights"] != before


def test_a_file_does_not_tell_where_it_was_made(exported: Exported) -> None:
    home = str(Path(formats.__file__).parents[2]).encode()
    for content in (exported.onnx, exported.program):
        assert home not in content
        assert b"deltas_nets/network" not in content
        assert sys.prefix.encode() not in content


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


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Run:
    """Run `deltas` with arguments, in this process."""
    return runner(monkeypatch, capfd)


def test_the_command_refuses_in_one_line(run: Run, tmp_path: Path) -> None:
    there = tmp_path / "there.onnx"
    there.write_bytes(b"mine")
    out = tmp_path / "x.onnx"
    assert_one_line(run("export", "--out", tmp_path / "x.bin"), "x.bin", "use .onnx or .pt2")
    assert_one_line(run("export", "--out", there), "the file exists", "--overwrite")
    assert there.read_bytes() == b"mine"
    assert_one_line(run("export", "--out", out, "--views", 1), "2 views or more")
    assert_one_line(run("export", "--out", out, "--size", 8, 8), "32 x 32")
    assert_one_line(run("export", "--out", out, "--depth-range", 3, 1), "near < far")
    assert_one_line(run("export", "--out", out, "--weights", "nothing"), "no such weights")
    assert_one_line(run("export"), "--out", "see deltas export --help")
    assert not out.exists()


def test_the_command_names_the_extra_that_is_missing(
    run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def find_spec(name: str) -> object:
        return None if name == "onnxruntime" else object()

    monkeypatch.setattr(formats, "find_spec", find_spec)
    result = run("export", "--out", tmp_path / "x.onnx")
    assert_one_line(result, "onnxruntime", 'pip install "deltas-depth[export]"')
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".onnx", ".pt2"])
def test_the_shipped_network_at_its_usual_size(run: Run, tmp_path: Path, suffix: str) -> None:
    needs_extra()
    out = tmp_path / f"deltas{suffix}"
    command = ("export", "--out", out, "--views", 3, "--points", 512, "--size", 240, 320)
    result = run(*command)
    assert result.code == 0, result.err
    assert result.err == ""
    assert "gives the network's depth" in result.out
    model, config = load_model(), ExportConfig(3, 512, (240, 320))
    content, eager = out.read_bytes(), FixedDeltas(model, config).eval()
    file = onnx_runner(content) if suffix == ".onnx" else program_runner(content, CPU)
    compared = 0
    for seed in range(20, 24):
        inputs = room(seed, config)
        with torch.no_grad():
            wanted = eager(*inputs)
        found = file(inputs)
        if same_points(found["keypoints"], wanted["keypoints"]):
            assert_same_depth(found, wanted)
            compared += 1
    assert compared >= 3
    with torch.no_grad():
        ours = fastest(lambda: eager(*inputs))
    print(f"\n{suffix}: {fastest(lambda: file(inputs)):.3f} s a map, eager {ours:.3f} s")


def fastest(call: Callable[[], object], repeats: int = 10) -> float:
    """Seconds of processor time that the fastest of some calls takes."""
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        call()
        times.append(time.process_time() - begin)
    return min(times)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["deltas-resnet50", "deltas-vgg9"])
def test_the_papers_networks_are_exported_too(name: str, tmp_path: Path) -> None:
    needs_extra()
    torch.manual_seed(0)
    model, config = Deltas(CONFIGS[name]).eval(), ExportConfig(2, 64, SIZE)
    assert export_onnx(model, tmp_path / "x.onnx", config).relative < TOLERANCE
    assert export_program(model, tmp_path / "x.pt2", config).relative < TOLERANCE
