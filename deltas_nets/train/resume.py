"""What a resumed run may change: where and how fast it computes, nothing that it computes."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from deltas_nets.config import TrainConfig
from deltas_nets.errors import UserError
from deltas_nets.train.checkpoint import CONFIG, WEIGHTS, load_config

OF_THE_MACHINE = ("devices", "num_nodes", "data.cache", "data.workers", "data.scannet.root")
"""Fields that change no result. The batch is that of all processes together, whatever their
number."""


def check_continues(folder: Path, config: TrainConfig) -> None:
    """Whether a config is that of the run in a folder, but for the machine's fields.

    Raises:
        UserError: names the first field that differs; or there is no run.
    """
    saved = load_config(folder)
    for name, value in _fields(config):
        if name not in OF_THE_MACHINE:
            _check(folder, name, saved, value)


def _check(folder: Path, name: str, saved: TrainConfig, value: Any) -> None:
    own = dict(_fields(saved))[name]
    if own == value:
        return
    remedy = "leave that option out, or start a new run in another folder"
    if name == "steps" and value > own:
        # The schedule of the learning rate is part of the result, and it has ended.
        remedy = (
            f"leave it out; a longer run is a new one from these weights: --out NEW "
            f"--init {folder / WEIGHTS} --start-step {own} --steps {value}"
        )
    raise UserError(f"the run to go on with has {name} {own}, not {value}", folder / CONFIG, remedy)


def _fields(config: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Names and values of the innermost fields: ``data.workers``, 1."""
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from _fields(value, f"{prefix}{field.name}.")
        else:
            yield prefix + field.name, value
