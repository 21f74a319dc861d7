"""The state of a training run in its folder, written so that a kill at any time loses little.

Every file is whole whenever it exists. The checkpoint is renamed into place last, so it never
speaks of weights that are not there, and a run goes on from the last one that was finished.
"""

import json
from pathlib import Path
from typing import NamedTuple

import torch

from deltas_nets.config import TrainConfig, from_dict, to_dict, without_paths
from deltas_nets.errors import UserError
from deltas_nets.network.networks import Network
from deltas_nets.network.torch_file import read_torch_file
from deltas_nets.outputs.atomic_files import write_atomically, write_json
from deltas_nets.train.average import RunningAverage
from deltas_nets.train.provenance import Provenance, record_of
from deltas_nets.weights_file import save_weights

CONFIG, CHECKPOINT, WEIGHTS = "config.json", "checkpoint.pt", "weights.safetensors"
_IN_A_CHECKPOINT = {"step", "origin", "model", "average", "optimizer"}


class RunState(NamedTuple):
    """What a run continues from."""

    model: Network
    average: RunningAverage
    optimizer: torch.optim.Optimizer
    step: int


def save_run(folder: Path, config: TrainConfig, state: RunState, provenance: Provenance) -> None:
    """Write the config, the checkpoint to resume from and the averaged weights.

    Args:
        folder: of the run.
        config: of the run.
        state: after ``state.step`` steps.
        provenance: where the weights come from.
    """
    write_json(folder / CONFIG, to_dict(config))
    average = state.average.model
    assert isinstance(average, Network)
    metadata = record_of(config, provenance) | {
        "step": str(state.step),
        "seed": str(config.seed),
        "train": json.dumps(to_dict(without_paths(config))),
    }
    save_weights(folder / WEIGHTS, average, metadata)
    content = {
        "step": state.step,
        **provenance._asdict(),
        "model": state.model.state_dict(),
        "average": average.state_dict(),
        "optimizer": state.optimizer.state_dict(),
    }
    write_atomically(folder / CHECKPOINT, lambda file: torch.save(content, file))


def load_config(folder: Path) -> TrainConfig:
    """The config of a run's folder.

    Raises:
        UserError: it is missing or of another version.
    """
    file = folder / CONFIG
    try:
        return from_dict(TrainConfig, json.loads(file.read_text(encoding="utf-8")))
    except FileNotFoundError:
        if (folder / WEIGHTS).exists():
            raise UserError("the run has no config", file, _from_weights(folder)) from None
        raise UserError("nothing to resume", folder, "name the --out of an earlier run") from None
    except (OSError, ValueError, TypeError, AttributeError) as error:
        whole = (folder / WEIGHTS).exists()
        remedy = _from_weights(folder) if whole else "start a new run"
        raise UserError(f"config is not readable ({error})", file, remedy) from None


def _from_weights(folder: Path) -> str:
    """What to do where a file of a run is damaged: its weights stand in one of their own."""
    return f"go on from its weights in a new folder: --init {folder / WEIGHTS}"


def load_run(folder: Path, state: RunState) -> tuple[RunState, Provenance]:
    """Put a run's checkpoint into model, average and optimizer.

    Returns:
        The state with its step, and where the weights come from.

    Raises:
        UserError: there is no checkpoint, it cannot be read, or is of another network.
    """
    file = folder / CHECKPOINT
    if not file.exists():
        raise UserError("no checkpoint to resume", file, "start without --resume")
    weights = _from_weights(folder)
    content = read_torch_file(file, remedy=weights)
    if not isinstance(content, dict) or not content.keys() >= _IN_A_CHECKPOINT:
        raise UserError("this is no checkpoint of a training", file, weights)
    try:
        state.model.load_state_dict(content["model"])
        state.average.model.load_state_dict(content["average"])
        state.optimizer.load_state_dict(content["optimizer"])
    except (RuntimeError, ValueError, TypeError, KeyError, AttributeError) as error:
        first = str(error).splitlines()[-1].strip()
        raise UserError(
            f"checkpoint of another version of the network ({first[:120]})",
            file,
            weights,
        ) from None
    # Checkpoints of before have the origin alone.
    said = {name: content[name] for name in Provenance._fields if name in content}
    return state._replace(step=content["step"]), Provenance(**said)
