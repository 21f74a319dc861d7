"""Exported networks give the depth of the network, whatever images and cameras they get."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest
import torch
from exported_depth import CPU, SIZE, assert_same_depth, needs_extra, room
from filelock import FileLock
from torch import Tensor

from deltas_nets.config import NetworkConfig
from deltas_nets.export import ExportConfig, formats
from deltas_nets.export.agreement import Inputs, RunExported, relative_difference, same_points
from deltas_nets.export.formats import (
    metadata_of,
    onnx_bytes,
    onnx_runner,
    program_bytes,
    program_runner,
)
from deltas_nets.export.graph import FixedDeltas, trace
from deltas_nets.network.deltas import Deltas
from deltas_nets.weights_file import load_model


class Exported(NamedTuple):
    """A network of so many views, and the file that it became."""

    model: Deltas
    config: ExportConfig
    form: str
    content: bytes
    run: RunExported

    def eager(self, inputs: Inputs) -> dict[str, Tensor]:
        with torch.no_grad():
            found: dict[str, Tensor] = FixedDeltas(self.model, self.config).eval()(*inputs)
        return found


# ONNX takes a minute to be made.
@pytest.fixture(
    scope="module",
    params=[
        pytest.param(("program", 3), id="program, 3 views"),
        pytest.param(("program", 2), id="program, 2 views", marks=pytest.mark.slow),
        pytest.param(("onnx", 3), id="ONNX, 3 views", marks=pytest.mark.slow),
        pytest.param(("onnx", 2), id="ONNX, 2 views", marks=pytest.mark.slow),
    ],
)
def exported(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Exported:
    needs_extra()
    form, num_views = request.param
    model, config = load_model(), ExportConfig(num_views, 64, SIZE)
    content = content_of(form, model, config, tmp_path_factory.getbasetemp())
    run = onnx_runner(content) if form == "onnx" else program_runner(content, CPU)
    return Exported(model, config, form, content, run)


def content_of(form: str, model: Deltas, config: ExportConfig, folder: Path) -> bytes:
    """The network's file, made once for all processes of a run."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    file = folder / f"{config.num_views}.{form}"
    with FileLock(f"{file}.lock"):
        if not file.exists():
            # Whatever the caller does: a program that holds traces of autocast cannot be loaded.
            with torch.autocast("cpu", enabled=config.num_views == 3):
                graph, metadata = trace(model, config), metadata_of(model, config, {"step": "7"})
            made = (
                onnx_bytes(graph, metadata, Path("x.onnx"))
                if form == "onnx"
                else program_bytes(graph, metadata)
            )
            file.write_bytes(made)
    return file.read_bytes()


def test_shapes_are_as_documented(exported: Exported) -> None:
    shapes = {
        "depth": (1, 1, *SIZE),
        "std": (1, 1, *SIZE),
        "keypoints": (1, 64, 2),
        "points": (1, 64, 3),
    }
    found = exported.run(room(1, exported.config))
    assert {name: tuple(tensor.shape) for name, tensor in found.items()} == shapes


def test_other_rooms_and_cameras_give_the_networks_depth(exported: Exported) -> None:
    depths: list[Tensor] = []
    for seed in range(20, 26):
        inputs = room(seed, exported.config)
        wanted = exported.eager(inputs)
        found = exported.run(inputs)
        if not same_points(found["keypoints"], wanted["keypoints"]):
            continue  # a tie of two detections, which rounding decides
        assert_same_depth(found, wanted)
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
        wanted, found = exported.eager(inputs), exported.run(inputs)
        assert wanted["depth"].isfinite().all()
        if same_points(found["keypoints"], wanted["keypoints"]):
            assert_same_depth(found, wanted)
            compared += 1
    assert compared > 0


def test_points_that_are_not_found_are_zero_in_the_file_too(exported: Exported) -> None:
    inputs = no_baseline(room(20, exported.config))
    assert (exported.run(inputs)["points"] == 0).all()
    seen = exported.run(room(20, exported.config))
    assert (seen["points"] != 0).any(-1).float().mean() > 0.5


ONNX = """
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
PROGRAM = """
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


def test_a_file_needs_its_runtime_alone_and_tells_what_it_is(
    exported: Exported, tmp_path: Path
) -> None:
    name, code = {"onnx": ("x.onnx", ONNX), "program": ("x.pt2", PROGRAM)}[exported.form]
    (tmp_path / name).write_bytes(exported.content)
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
    assert known["image_range"] == [0, 1] and "[0, 1]" in known["inputs"]["images"]
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
    for told in (home, b"deltas_nets/network", sys.prefix.encode()):
        assert told not in exported.content
