"""What a fusion knows after some frames, in one file, so that a run that was stopped goes on."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from deltas_nets.fuse.depth_view import DepthView
from deltas_nets.fuse.left_out import LeftOut
from deltas_nets.outputs.atomic_files import write_atomically
from deltas_nets.outputs.beside import FUSE_STATE

__all__ = ["Sums", "read_state", "write_state"]


class Sums(Protocol):
    """What adds views up: a `Cloud`, a `Volume`."""

    def add(self, view: DepthView) -> None:
        """Add one."""

    def state(self) -> dict[str, torch.Tensor]:
        """The sums."""

    def restore(self, state: dict[str, torch.Tensor]) -> None:
        """Take them over."""


def write_state(
    folder: Path, sums: Mapping[str, Sums], done: Mapping[str, LeftOut | None], settings: object
) -> None:
    """Write the sums of the frames that are done, and what was left out of each, atomically.

    Raises:
        UserError: the system refuses.
    """
    tensors = {
        f"{name}.{part}": tensor.contiguous().cpu()
        for name, added in sums.items()
        for part, tensor in added.state().items()
    }
    metadata = {"done": json.dumps(done), "settings": json.dumps(settings)}
    # By its name: in memory the bytes would be there twice.
    write_atomically(folder / FUSE_STATE, lambda file: save_file(tensors, file.name, metadata))


def read_state(
    folder: Path, sums: Mapping[str, Sums], settings: object
) -> dict[str, LeftOut | None]:
    """Restore the sums of an earlier run.

    Returns:
        The frames that they hold, each with what was left out; none where no run of these
        settings left any.
    """
    try:
        with safe_open(str(folder / FUSE_STATE), framework="pt") as opened:
            metadata = opened.metadata() or {}
            if metadata.get("settings") != json.dumps(settings):
                return {}
            names = opened.keys()
            tensors = {name: opened.get_tensor(name) for name in names}
    except (SafetensorError, OSError):
        return {}
    for name, added in sums.items():
        start = f"{name}."
        added.restore(
            {
                key.removeprefix(start): value
                for key, value in tensors.items()
                if key.startswith(start)
            }
        )
    done: dict[str, list[float] | None] = json.loads(metadata["done"])
    return {id: None if shares is None else LeftOut(*shares) for id, shares in done.items()}
