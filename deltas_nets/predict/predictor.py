"""Which network a weights file holds: one of deltas, or the published one."""

import hashlib
from pathlib import Path
from typing import Any

import torch

from deltas_nets import reference
from deltas_nets.config import to_dict
from deltas_nets.errors import UserError
from deltas_nets.network.deltas import Deltas
from deltas_nets.reference import ReferenceNetwork
from deltas_nets.weights_file import load_model, weights_file, weights_record

AnyNetwork = Deltas | ReferenceNetwork


def load_network(name_or_file: str | Path, device: str | torch.device = "cpu") -> AnyNetwork:
    """The network of a shipped name, of a file of `deltas train`, or of the published checkpoint.

    Args:
        name_or_file: what the file holds is read from it, not from its name.
        device: where to put it.

    Raises:
        UserError: no such file, or it holds none of these, or not all of its weights.

    Example:
        >>> load_network("deltas-small").config.name
        'deltas-small'
    """
    file = weights_file(name_or_file)
    if reference.is_published(file):
        return reference.load(file, device=device)
    if not _is_safetensors(file):
        raise UserError(
            "neither weights of deltas train nor the published checkpoint",
            file,
            "name a weights.safetensors, or the file that the authors of the paper published",
        )
    return load_model(name_or_file, device)


def network_record(network: AnyNetwork) -> dict[str, Any]:
    """What a network is, for the record of a run."""
    if isinstance(network, ReferenceNetwork):
        return {"name": "published"}
    return to_dict(network.config)


def file_record(name_or_file: str, network: AnyNetwork) -> dict[str, str]:
    """What identifies the file that a network was loaded from, and where it comes from."""
    if isinstance(network, Deltas):
        return weights_record(name_or_file)
    content = weights_file(name_or_file).read_bytes()
    return {
        "name": name_or_file,
        "sha256": hashlib.sha256(content).hexdigest(),
        "origin": "the published checkpoint",
    }


def _is_safetensors(file: Path) -> bool:
    """Its header is JSON after eight bytes of its length; torch's files are archives or pickles."""
    with file.open("rb") as opened:
        return opened.read(9)[8:] == b"{"
