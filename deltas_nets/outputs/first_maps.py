"""Maps of the passes before the last, kept until all are there: safetensors beside the outputs."""

import json
import re
from collections.abc import Mapping
from copy import copy
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save

from deltas_nets.network.known_depth import KnownDepth
from deltas_nets.outputs.atomic_files import plain, write_atomically

__all__ = ["FIRST", "FirstMaps"]

FIRST = "first"
"""The folder's name, of a shard with its number."""
PARTS = re.compile(rf"{FIRST}(\.\d+-of-\d+)?")


class FirstMaps:
    """What the first pass found of each frame, on the disk: a run that was killed goes on.

    Args:
        out: the folder of outputs.
        shard: of how many runs that fill it; each keeps its own maps, and hears no others: what
            comes out must not depend on which of them is ahead.
    """

    def __init__(self, out: Path, shard: tuple[int, int] = (1, 1)) -> None:
        part = "" if shard[1] == 1 else ".{}-of-{}".format(*shard)
        self.folder = out / f"{FIRST}{part}"

    def of_pass(self, number: int) -> "FirstMaps":
        """Those of a later pass, 2 or more; they go when the first ones go."""
        later = copy(self)
        later.folder = self.folder / f"pass-{number}"
        return later

    def file(self, id: str) -> Path:
        """Where the map of a frame lies."""
        return self.folder / f"{id}.safetensors"

    def write(self, id: str, found: KnownDepth, record: Mapping[str, Any]) -> None:
        """Keep a map ``(1, h, w)`` and what the summary will say of it.

        Raises:
            UserError: the system refuses.
        """
        tensors = {"depth": found.depth.float(), "deviation": found.deviation.half()}
        tensors = {name: tensor.cpu().contiguous() for name, tensor in tensors.items()}
        content = save(tensors, {"record": json.dumps(plain(record))})
        file = self.file(id)
        file.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(file, lambda opened: opened.write(content))

    def read(self, id: str) -> tuple[KnownDepth, dict[str, Any]] | None:
        """The map of a frame and its record; None where it is not there, or damaged."""
        try:
            with safe_open(self.file(id), framework="pt") as opened:
                tensors = [opened.get_tensor(name).float() for name in ("depth", "deviation")]
                record: dict[str, Any] = json.loads(opened.metadata()["record"])
        except (OSError, SafetensorError, KeyError, ValueError, TypeError):
            return None
        depth, deviation = tensors
        usable = (depth > 0) & (depth < torch.inf) & (deviation > 0) & (deviation < torch.inf)
        return KnownDepth(torch.where(usable, depth, 0.0), deviation), record

    @staticmethod
    def remove_all(out: Path) -> None:
        """Remove those of all runs."""
        for folder in out.glob(f"{FIRST}*"):
            if folder.is_dir() and PARTS.fullmatch(folder.name):
                _remove(folder)

    def remove(self) -> None:
        """Remove them; the outputs are there."""
        _remove(self.folder)


def _remove(folder: Path) -> None:
    for file in sorted(folder.rglob("*"), reverse=True):
        file.unlink() if file.is_file() else file.rmdir()
    if folder.is_dir():
        folder.rmdir()
