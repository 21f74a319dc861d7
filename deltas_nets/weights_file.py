"""Weights in files: the shipped ones by name, others by path; safetensors only."""

import hashlib
import json
from collections.abc import Iterable, Mapping
from importlib.resources import files
from os.path import isdir, isfile  # no error of a name that is too long
from pathlib import Path
from textwrap import shorten

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save
from torch import Tensor

from deltas_nets.config import NetworkConfig, from_dict, to_dict
from deltas_nets.config.baselines import BASELINES
from deltas_nets.errors import UserError
from deltas_nets.extras import usable_device
from deltas_nets.network.deltas import Deltas
from deltas_nets.network.networks import Network, build_network
from deltas_nets.network.torch_file import check_finite_weights
from deltas_nets.outputs.atomic_files import check_file, write_atomically

DEFAULT = "deltas-small"
FORMAT = "1"
REDRAW = "redraw."
"""What the names of the weights of the stage that redraws begin with."""


def load_model(name_or_file: str | Path = DEFAULT, device: str | torch.device = "cpu") -> Deltas:
    """A trained network, ready to predict.

    Args:
        name_or_file: a shipped network ("deltas-small"), or a weights file of `deltas train`.
        device: where to put it; "auto" is a CUDA device where there is one.

    Raises:
        UserError: no such network, file or device, or the file holds something else, such as a
            network without points.

    Example:
        >>> load_model().config.name
        'deltas-small'
    """
    network = load_network(name_or_file, device)
    if isinstance(network, Deltas):
        return network
    raise UserError(
        f"{network.config.name} has no points, and none of the stages wanted here",
        weights_file(name_or_file),
        f"name weights of a deltas network ({DEFAULT})",
    )


def load_network(name_or_file: str | Path, device: str | torch.device = "cpu") -> Network:
    """A trained network of any kind that `deltas train` trains; arguments as of `load_model`."""
    file, device = weights_file(name_or_file), usable_device(device)
    metadata = read_metadata(file)
    if "network" not in metadata:
        raise UserError("this file holds no deltas network", file, "name a file of deltas train")
    try:
        config = from_dict(NetworkConfig, json.loads(metadata["network"]))
    except (KeyError, ValueError, TypeError, RecursionError) as error:
        raise UserError(
            f"weights of another version ({error})", file, "train again or install that version"
        ) from None
    model = build_network(config)
    load_weights(model, file)
    return model.to(device).eval()


def weights_file(name_or_file: str | Path, *, beside: Iterable[str] = ()) -> Path:
    """The file of a shipped network's name, or the given file.

    Args:
        name_or_file: of the weights.
        beside: names without a file that whoever asks takes as well, to be told.

    Raises:
        UserError: there is no such file.
    """
    file = Path(name_or_file)
    shipped = Path(str(files("deltas_nets") / "weights" / f"{name_or_file}.safetensors"))
    if file.suffix != ".safetensors" and isfile(shipped):
        return shipped
    if isdir(file):
        inside = file / "weights.safetensors"
        remedy = f"name {inside}" if inside.is_file() else "name a .safetensors file"
        raise UserError("this is a folder, not weights", file, remedy)
    if not isfile(file):
        names = (DEFAULT, *beside)
        known = f"one of {', '.join(names)}" if len(names) > 1 else DEFAULT
        if str(name_or_file) in BASELINES:
            known = f"{DEFAULT}: {file} has none"
        raise UserError("no such weights", file, f"name a .safetensors file or {known}")
    return file


def read_metadata(file: Path) -> dict[str, str]:
    """Config, data, seed, step and licence recorded in a weights file.

    Raises:
        UserError: not a safetensors file.
    """
    try:
        with safe_open(str(file), framework="pt") as opened:
            metadata: dict[str, str] | None = opened.metadata()
    except (SafetensorError, OSError) as error:
        raise UserError(
            f"not a safetensors file ({error})",
            file,
            "name the weights.safetensors that deltas train wrote",
        ) from None
    return metadata or {}


def weights_record(name: str) -> dict[str, str]:
    """What identifies weights by name or file, and where they come from."""
    file = weights_file(name)
    metadata = read_metadata(file)
    record = {"name": name, "sha256": sha256_of(file)}
    for key in ("step", "seed", "data", "origin"):
        if key in metadata:
            record[key] = metadata[key]
    return record


def sha256_of(file: Path) -> str:
    """The fingerprint of a file's content."""
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()


def load_weights(model: torch.nn.Module, file: Path) -> None:
    """Copy a file's weights into a model of the same shape.

    Raises:
        UserError: a weight is missing, left over, of another shape, or no finite number.
    """
    _load(model, load_file(file), file)


def start_from_weights(model: torch.nn.Module, file: Path) -> list[str]:
    """Copy a file's weights into a model that may have grown since; training goes on from there.

    A stage that redraws stays behind where the model has none: it follows features that change.

    Returns:
        Weights that the file lacks: they stay as they are.

    Raises:
        UserError: a weight is left over, of another shape or no finite number, or more than half
            are lacking: these are another network's.
    """
    state = load_file(file)
    own = model.state_dict()
    if not any(name.startswith(REDRAW) for name in own):
        state = {name: value for name, value in state.items() if not name.startswith(REDRAW)}
    grown = {name: value for name, value in own.items() if name not in state}
    if 2 * len(grown) > len(own):
        raise UserError(
            f"weights do not fit the network ({len(grown)} of {len(own)} are lacking)",
            file,
            "name a weights file of this kind of network",
        )
    _load(model, {**grown, **state}, file)
    return list(grown)


def _load(model: torch.nn.Module, state: dict[str, Tensor], file: Path) -> None:
    check_finite_weights(state, file)
    own = model.state_dict()
    for name, value in state.items():
        # Copying would round: a file of whole numbers was made for another program.
        if name in own and own[name].is_floating_point() and not value.is_floating_point():
            what = f"{name} holds whole numbers ({value.dtype})"
            raise UserError(what, file, "name the weights.safetensors that deltas train wrote")
    try:
        model.load_state_dict(state)
    except RuntimeError as error:
        first = str(error).splitlines()[1].strip() if "\n" in str(error) else str(error)
        first = shorten(first, 150, placeholder=" ...")  # it may name hundreds
        raise UserError(
            f"weights do not fit the network ({first})", file, "use the config they were trained by"
        ) from None


def with_last(listed: str, new: str) -> str:
    """A list in a record with an item at its end, and nowhere before.

    Example:
        >>> with_last("rooms; ScanNet", "rooms")
        'ScanNet; rooms'
    """
    kept = [part for part in listed.split("; ") if part and part != new]
    return "; ".join([*kept, new])


def check_new_weights(file: Path, *, overwrite: bool) -> None:
    """Whether weights can be written to a file, before hours of work.

    Raises:
        UserError: it is no .safetensors file, is a folder, exists already, or cannot be written.
    """
    if file.suffix != ".safetensors":
        raise UserError("weights are .safetensors", file, "name such a file with --out")
    check_file(file, remedy="name a file with --out")
    if file.exists() and not overwrite:
        raise UserError("the file exists", file, "add --overwrite or name a new file")


def save_weights(file: Path, model: Network, metadata: Mapping[str, str]) -> None:
    """Write weights and where they come from, atomically.

    Args:
        file: ends in .safetensors.
        model: on any device.
        metadata: recorded beside the network's config: data, seed, step, licence.
    """
    state = {
        name: tensor.detach().cpu().contiguous() for name, tensor in model.state_dict().items()
    }
    record = {
        **metadata,
        "format": FORMAT,
        "network": json.dumps(to_dict(model.config)),
        "torch": torch.__version__,
    }
    write_atomically(file, lambda opened: opened.write(save(state, metadata=record)))
