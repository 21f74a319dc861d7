"""The shipped network and the paper's, exported: minutes each."""

import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from exported_depth import CPU, SIZE, assert_same_depth, needs_extra, room
from run_command import Run

from deltas_nets.config import CONFIGS
from deltas_nets.export import ExportConfig, export_onnx, export_program
from deltas_nets.export.agreement import TOLERANCE, same_points
from deltas_nets.export.formats import onnx_runner, program_runner
from deltas_nets.export.graph import FixedDeltas
from deltas_nets.network.deltas import Deltas
from deltas_nets.weights_file import load_model


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
