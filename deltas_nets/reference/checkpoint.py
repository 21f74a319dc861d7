"""The file of the reference network: three tables of weights, read without running any code."""

import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from deltas_nets.errors import UserError
from deltas_nets.network.torch_file import all_finite
from deltas_nets.reference.network import ReferenceNetwork

ENTRIES = ("state_dict", "state_dict_tri", "state_dict_depth")
"""Tables of the image network, the matcher and the densifier."""

Table = Mapping[str, Any]

# A confidence layer that the original stored but never used.
_UNUSED = ("convD_confa.", "bnconvD_confa.")
_COUNTER = "num_batches_tracked"
_REMEDY = "name the checkpoint that the authors of the paper published"


def is_published(file: str | Path) -> bool:
    """Whether a file is a checkpoint in the layout of the reference network.

    Only the three tables' names are looked at; :func:`load` checks what is in them.
    """
    try:
        entries = _read(Path(file))
    except UserError:
        return False
    return all(isinstance(entries.get(name), Mapping) for name in ENTRIES)


def load(*source: str | Path | Table, device: str | torch.device = "cpu") -> ReferenceNetwork:
    """The reference network with the weights of a checkpoint.

    Args:
        source: a file; or a mapping with the entries ``state_dict``, ``state_dict_tri`` and
            ``state_dict_depth``; or these three tables, in this order. Tables map the names of
            the layers to tensors or arrays, which are copied.
        device: where to put it.

    Raises:
        UserError: the file cannot be read, or a weight is missing, left over, of another shape
            or not finite.
        TypeError: neither one nor three sources.

    Example:
        >>> load("nowhere.pth")
        Traceback (most recent call last):
        deltas_nets.errors.UserError: no such file, nowhere.pth: name the checkpoint ...
    """
    where: str | Path = "the given tables"
    if len(source) == 1 and isinstance(source[0], str | Path):
        where = Path(source[0])
        entries = _read(where)
    elif len(source) == 1 and isinstance(source[0], Mapping):
        entries = source[0]
    elif len(source) == len(ENTRIES):
        entries = dict(zip(ENTRIES, source, strict=True))
    else:
        raise TypeError(f"load takes a file, a mapping or {len(ENTRIES)} tables")
    # Without memory of its own, the network takes that of the weights.
    with torch.device("meta"):
        network = ReferenceNetwork()
    image_parts = (network.encoder, network.detector_head, network.descriptor_head)
    depth_parts = (network.densifier.encoder, network.densifier.decoder)
    parts: tuple[Sequence[nn.Module], ...] = (image_parts, (network.match_norm,), depth_parts)
    tables = [entries.get(entry) for entry in ENTRIES]
    for entry, modules, table in zip(ENTRIES, parts, tables, strict=True):
        check_table(modules, table, entry, where)
    for modules, table in zip(parts, tables, strict=True):
        fill_from_table(modules, table or {})
    return network.to(device).requires_grad_(False).eval()


def check_table(parts: Sequence[nn.Module], table: Any, entry: str, where: str | Path) -> None:
    """Whether a table holds exactly the weights of some modules.

    Args:
        parts: modules without a common name: the table's keys are those of all of them.
        table: from names to tensors or arrays; counters of batches may be absent.
        entry: its name, for errors.
        where: the file it comes from, for errors.

    Raises:
        UserError: a weight is missing, left over, of another shape or not finite.
    """
    if not isinstance(table, Mapping):
        raise UserError(f"no table {entry}", where, _REMEDY)
    expected = {key: value.shape for part in parts for key, value in part.state_dict().items()}
    for key, shape in expected.items():
        if key not in table and key.endswith(_COUNTER):
            continue  # only training would count on
        if key not in table:
            raise UserError(f"{entry} has no {key}", where, _REMEDY)
        if not isinstance(table[key], Tensor | np.ndarray):
            kind = type(table[key]).__name__
            raise UserError(f"{key} of {entry} is a {kind}, not a tensor", where, _REMEDY)
        if tuple(table[key].shape) != tuple(shape):
            raise UserError(
                f"{key} of {entry} has shape {tuple(table[key].shape)}, not {tuple(shape)}",
                where,
                _REMEDY,
            )
        if not all_finite(torch.as_tensor(table[key])):
            raise UserError(f"{key} of {entry} is not finite", where, _REMEDY)
    left = [key for key in table if key not in expected and not str(key).startswith(_UNUSED)]
    if left:
        raise UserError(f"{entry} holds {left[0]}, which no layer has", where, _REMEDY)


def fill_from_table(parts: Sequence[nn.Module], table: Table) -> None:
    """Give modules copies of the weights of a table that :func:`check_table` accepts."""
    for part in parts:
        weights = {key: _copied(table, key) for key in part.state_dict()}
        part.load_state_dict(weights, assign=True)


def _copied(table: Table, key: str) -> Tensor:
    if key.endswith(_COUNTER):
        return torch.as_tensor(table.get(key, 0)).to(torch.long, copy=True)
    return torch.as_tensor(table[key]).detach().to(torch.float32, copy=True)


def _read(file: Path) -> Table:
    """The entries of a torch file.

    Raises:
        UserError: there is no such file, or it holds something else than plain tensors.
    """
    if not file.is_file():
        raise UserError("no such file", file, _REMEDY)
    try:
        # Files of torch before 1.6 are no zip archives and cannot be mapped.
        entries = torch.load(
            file, map_location="cpu", weights_only=True, mmap=zipfile.is_zipfile(file)
        )
    except Exception as error:  # a damaged pickle may raise anything
        raise UserError(f"not a torch file of plain tensors ({error})", file, _REMEDY) from None
    if not isinstance(entries, Mapping):
        raise UserError(f"holds a {type(entries).__name__}, not tables", file, _REMEDY)
    return entries
