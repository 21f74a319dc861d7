"""What a run starts from: random weights, an encoder, a weights file or its own checkpoint."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import nn

from deltas_nets.config import TrainConfig
from deltas_nets.distill.supervision import TeacherLabels
from deltas_nets.distill.teachers import load_teacher
from deltas_nets.errors import UserError
from deltas_nets.network.networks import Network, build_network
from deltas_nets.train.average import RunningAverage
from deltas_nets.train.batch_norm import prepare_batch_norm
from deltas_nets.train.checkpoint import RunState, load_run
from deltas_nets.train.freeze import frozen_stages
from deltas_nets.train.optimiser import make_optimizer
from deltas_nets.train.provenance import TEACHER, Provenance, check_began
from deltas_nets.train.resume import check_continues
from deltas_nets.train.step import unreached
from deltas_nets.weights_file import read_metadata, sha256_of, start_from_weights, weights_file

if TYPE_CHECKING:
    from lightning_fabric import Fabric


@dataclass(frozen=True)
class Start:
    """What a run starts from.

    Attributes:
        encoder: a public checkpoint for the encoder.
        init: a weights file for the whole network, which may have grown since.
        step: the first step, for a schedule that goes on from ``init``.
        resume: go on from the checkpoint in the run's folder. Files and a step that are given
            beside it are only compared with those that the run began with.
        teacher: weights of the teacher that the config names. They are in no checkpoint: to go on
            it is given again.
        random_encoder: an encoder of random weights is asked for, rather than nothing said.
    """

    encoder: Path | None = None
    init: Path | None = None
    step: int = 0
    resume: bool = False
    teacher: Path | None = None
    random_encoder: bool = False

    def began(self) -> dict[str, str]:
        """SHA-256 of each file that is named, by its option, and the step if it is not 0."""
        files = {"--encoder": self.encoder, "--init": self.init, TEACHER: self.teacher}
        step = {"--start-step": str(self.step)} if self.step else {}
        return step | {
            # A teacher of ours may be a name.
            option: sha256_of(weights_file(file))
            for option, file in files.items()
            if file is not None
        }

    def said(self) -> dict[str, str | None]:
        """What a run to go on with is said to have begun with; None is of no file."""
        return ({"--encoder": None} if self.random_encoder else {}) | self.began()


class Started(NamedTuple):
    """A run about to take its next step.

    Attributes:
        state: on this process's device.
        provenance: where its weights come from.
        teacher: of the detector, on this process's device; None where the config names none.
    """

    state: RunState
    provenance: Provenance
    teacher: TeacherLabels | None


def starting_state(
    config: TrainConfig,
    folder: Path,
    start: Start,
    fabric: "Fabric",
    report: Callable[[str], None] = lambda _: None,
) -> Started:
    """Network, average and optimizer, the same in every process.

    Args:
        config: of the run.
        folder: of the run.
        start: what to start from.
        fabric: launched.
        report: gets lines about what was done.

    Raises:
        UserError: a file to start from is missing or does not fit, or the run to go on with has
            another config or began with another file.
    """
    if start.resume:
        check_continues(folder, config)
    teacher = _teacher(config, start)  # first: nothing has been computed yet
    torch.manual_seed(config.seed)
    model = build_network(config.network)
    origin, before = "random weights", None
    if start.encoder is not None and not start.resume:
        model.encoder.load_pretrained(start.encoder)
        origin = f"encoder from {model.encoder.origin}"
    if start.init is not None and not start.resume:
        if not start.init.is_file():
            raise UserError("no such weights", start.init, "name a .safetensors file with --init")
        before = read_metadata(start.init)
        origin = before.get("origin", "unknown weights")
        new = start_from_weights(model, start.init)
        if new:
            report(f"{start.init} lacks {len(new)} weights of this network: they start anew")
        model.calibration.reset()  # it was fitted to what is about to change
    for stage in frozen_stages(model, config):
        stage.requires_grad_(False)
    if config.freeze or fabric.world_size > 1:
        idle = _idle(model, config)
        # One process keeps them: its checkpoints have had them all along.
        for parameter in idle if fabric.world_size > 1 else ():
            parameter.requires_grad_(False)
    # On the device before anything copies the weights or keeps state beside them.
    fabric.to_device(model)
    average = RunningAverage(model, config.average)
    optimizer = make_optimizer(model, config)
    state = RunState(model, average, optimizer, start.step)
    provenance = Provenance(origin, before, start.began())
    if start.resume:
        state, provenance = load_run(folder, state)
        check_began(provenance.began, start.said(), folder)
    prepare_batch_norm(model, config, processes=fabric.world_size)
    if teacher is None:
        return Started(state, provenance, None)
    return Started(state, provenance, TeacherLabels(fabric.to_device(teacher)))


def _idle(model: Network, config: TrainConfig) -> list[nn.Parameter]:
    """What is not frozen and no loss reaches.

    Raises:
        UserError: there is nothing else.
    """
    parameters = dict(model.named_parameters())
    idle = [parameters[name] for name in unreached(model, config)]
    if len(idle) == sum(parameter.requires_grad for parameter in parameters.values()):
        what = "no loss teaches what is not frozen"
        raise UserError(what, f"--freeze {' '.join(config.freeze)}", "leave another stage out")
    return idle


def _teacher(config: TrainConfig, start: Start) -> nn.Module | None:
    """The teacher that the config names.

    Raises:
        UserError: there is no such teacher, or its weights are missing or another's.
    """
    if config.teacher is None and start.teacher is not None:
        raise UserError("whose weights are these?", "--teacher-weights", "add --teacher NAME")
    if config.teacher is None:
        return None
    if start.teacher is None:
        raise UserError(
            f"no weights for {config.teacher}", "--teacher", "add --teacher-weights FILE"
        )
    return load_teacher(config.teacher, start.teacher)
