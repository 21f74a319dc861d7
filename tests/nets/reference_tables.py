"""Weights in the published layout, random or by the formula of the shared reference."""

import zlib
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from deltas_nets.reference import ReferenceNetwork
from deltas_nets.reference.checkpoint import ENTRIES

Tables = dict[str, dict[str, Tensor]]


def random_tables() -> Tables:
    """Weights of the published shapes, all of them views of one small storage: small files."""
    generator = torch.Generator().manual_seed(0)
    numbers = 0.03 * torch.randn(80000, generator=generator)
    with torch.device("meta"):
        network = ReferenceNetwork()

    def table(*parts: torch.nn.Module) -> dict[str, Tensor]:
        return {
            key: weight(key, value.shape)
            for part in parts
            for key, value in part.state_dict().items()
        }

    def weight(key: str, shape: torch.Size) -> Tensor:
        if key.endswith("num_batches_tracked"):
            return torch.tensor(7)
        if key.endswith(("running_var", "weight")) and len(shape) == 1:
            return numbers.new_ones(1).expand(shape)
        if shape.numel() <= len(numbers):
            return numbers[: shape.numel()].view(shape)
        row = shape[1:]  # all output channels alike
        return numbers[: row.numel()].view(row).expand(shape)

    tables = (
        table(network.encoder, network.detector_head, network.descriptor_head),
        table(network.match_norm),
        table(network.densifier.encoder, network.densifier.decoder),
    )
    unused = {"convD_confa.weight": numbers[:9].view(1, 1, 3, 3), "bnconvD_confa.bias": numbers[:1]}
    tables[1].update(unused)
    return dict(zip(ENTRIES, tables, strict=True))


def formula_tensor(entry: str, key: str, shape: list[int]) -> NDArray[Any]:
    """Weights that the original network was run with."""
    seed = zlib.crc32(f"deltas{entry}.{key}".encode())
    z = np.random.default_rng(seed).standard_normal(tuple(shape)).astype(np.float32)
    tenth = np.float32(0.1)
    if key.endswith("running_var"):
        return np.asarray(np.exp(tenth * z))
    if key.endswith(("running_mean", "bias")):
        return tenth * z
    if len(shape) == 1:
        return np.float32(1) + tenth * z
    return z * np.float32(1 / np.sqrt(np.prod(shape[1:])))
