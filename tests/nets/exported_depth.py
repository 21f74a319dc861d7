"""Inputs of exported networks, and when their depth is that of the network."""

import pytest
import torch
from torch import Tensor

from deltas_nets.export import ExportConfig
from deltas_nets.export.agreement import TOLERANCE, Inputs, inputs_of, relative_difference
from deltas_nets.rooms import render_room

SIZE = (64, 96)
CPU = torch.device("cpu")


def needs_extra() -> None:
    for package in ("onnx", "onnxscript", "onnxruntime"):
        pytest.importorskip(package, reason="needs the extra 'export'")


def room(seed: int, config: ExportConfig) -> Inputs:
    return inputs_of(render_room(seed, num_views=config.num_views, image_size=config.image_size))


def assert_same_depth(found: dict[str, Tensor], wanted: dict[str, Tensor]) -> None:
    assert relative_difference(found["depth"], wanted["depth"]) < TOLERANCE
    # An estimate of an error: two digits of it are more than it is good for.
    assert relative_difference(found["std"], wanted["std"]) < 0.01
