"""The training loop: one step after another, with everything that survives a kill."""

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from torch import nn
from torch.utils.data import Subset

from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.config import TrainConfig
from deltas_nets.errors import UserError
from deltas_nets.evaluate.rooms import evaluate_rooms
from deltas_nets.outputs.atomic_files import remove_temporary
from deltas_nets.rooms import Rooms
from deltas_nets.terminal import counted
from deltas_nets.train.batches import BatchMaker
from deltas_nets.train.checkpoint import WEIGHTS, save_run
from deltas_nets.train.data_sets import training_data, validation_data
from deltas_nets.train.first_frames import check_frames
from deltas_nets.train.loader import step_loader
from deltas_nets.train.log import FolderLog, RunLog
from deltas_nets.train.optimiser import set_learning_rate
from deltas_nets.train.processes import launch_fabric, part_of
from deltas_nets.train.start import Start as Start
from deltas_nets.train.start import starting_state
from deltas_nets.train.step import DEPTH_RANGE, Objective, Stepper
from deltas_nets.train.stop import StopRequest

if TYPE_CHECKING:
    from lightning_fabric import Fabric

VALIDATION_SEED = 0  # of the first of the rooms that no training sees
PATIENCE = 20
"""A bad batch must not end a night's training; so many steps without a usable gradient do."""


def fit(
    config: TrainConfig,
    folder: Path,
    start: Start,
    *,
    checkpoint_every: int = 200,
    validate_every: int = 500,
    log_every: int = 20,
    stop: int | None = None,
    report: Callable[[str], None] = print,
) -> Path:
    """Train a network.

    With several processes each of them calls it with the same arguments; the first one writes.

    Args:
        config: the whole run.
        folder: gets config.json, checkpoint.pt, weights.safetensors (the running average),
            log.jsonl and TensorBoard's event files. All machines see it.
        start: what to start from.
        checkpoint_every: steps between checkpoints.
        validate_every: steps between evaluations on held-out rooms or scenes.
        log_every: steps between entries in the log.
        stop: end after this step, to be resumed later; the schedule stays that of the config.
        report: where messages go.

    Returns:
        The weights file.

    Raises:
        UserError: a file to start from is missing or does not fit, there is nothing to train on,
            or training diverged; in all processes.
        KeyboardInterrupt: Ctrl-C or SIGTERM, after the step was finished and saved. A validation
            is left undone, and made up for by the run that goes on.
    """
    fabric = launch_fabric(config)
    tell = report if fabric.is_global_zero else _silently
    data, held_out = training_data(config, report=tell), validation_data(config, report=tell)
    check_frames(data, held_out, DEPTH_RANGE, report=tell)
    state, provenance, teacher = starting_state(config, folder, start, fabric, tell)
    objective = Objective(state.model, config)
    wrapped, optimizer = fabric.setup(objective, state.optimizer)
    stepper = Stepper(objective, wrapped, optimizer, fabric, teacher)
    maker = BatchMaker(config, part_of(fabric))
    step, last = state.step, min(config.steps, stop or config.steps)
    loader = step_loader(
        data, config, start=step, stop=last, part=part_of(fabric), device=fabric.device
    )
    saved = step if start.resume else -1

    def save() -> None:
        nonlocal saved
        if fabric.is_global_zero and saved != step:
            save_run(folder, config, state._replace(step=step), provenance)
        saved = step

    if fabric.is_global_zero:
        folder.mkdir(parents=True, exist_ok=True)
        remove_temporary(folder.iterdir())
    save()  # before the first step, so that a run can always be resumed
    failures, without_use = 0, Counter[str]()
    log_of_run = _log(fabric, folder, config, step, report)
    asked = StopRequest(tells=fabric.is_global_zero)
    with _counted_at_the_end(without_use, tell), asked as request, log_of_run as log:

        def validate_at(step: int) -> None:
            if step == 0 or (step % validate_every and step != last) or log.validated(step):
                return
            save()  # a validation takes minutes: who stops or kills it meanwhile loses no step
            # Of several processes the others would wait for the first one.
            alone = request.obeyed_at_once() if fabric.world_size == 1 else nullcontext()
            with alone:
                metrics = metrics_of(state.average.model, held_out)
            log.validation(step, metrics)

        validate_at(step)  # where a run that was stopped left it undone
        for rooms in loader:
            began = time.perf_counter()
            rate = set_learning_rate(state.optimizer, step, config)
            batch = maker(rooms, step)
            result = stepper(batch, stop=request.made)
            if not result.done:
                without_use.update([", ".join(result.not_finite)])
            else:
                state.average.update(state.model, step)
            step += 1
            if step % log_every == 0 or step == last:
                seconds = time.perf_counter() - began
                log.losses(step, result.losses, rate=rate, seconds=seconds)
            log.progress(step)
            failures = 0 if result.done else failures + 1
            if failures == PATIENCE:
                what = f"training diverged: no usable gradient in the {PATIENCE} steps up to {step}"
                what = f"{what}; not finite: {', '.join(result.not_finite)}"
                raise UserError(what, folder, "lower --learning-rate, or mend a loss of your own")
            stopped = result.stop and step < last
            if stopped or step % checkpoint_every == 0 or step == last:
                save()
            if stopped:  # whoever stops a run does not wait for its validation
                fabric.barrier()  # torchrun ends the others when one is gone
                raise KeyboardInterrupt
            validate_at(step)
    fabric.barrier()
    return folder / WEIGHTS


@contextmanager
def _counted_at_the_end(
    without_use: Mapping[str, int], tell: Callable[[str], None]
) -> Iterator[None]:
    """Tell of the steps that changed nothing, however the run ends."""
    try:
        yield
    finally:
        for names, count in without_use.items():
            tell(f"{counted(count, 'step')} changed nothing; not finite: {names}")


def _silently(message: str) -> None:
    """Processes that are not the first report nothing."""


def _log(
    fabric: "Fabric",
    folder: Path,
    config: TrainConfig,
    step: int,
    report: Callable[[str], None],
) -> RunLog:
    if not fabric.is_global_zero:
        return RunLog()
    return FolderLog(folder, config, step=step, report=report)


def metrics_of(model: nn.Module, held_out: Subset[PosedImages] | None) -> dict[str, float]:
    """Depth metrics on held-out view sets, on rooms if there are none."""
    if held_out is None:
        return validate(model)
    return evaluate_rooms(model, held_out, depth_range=DEPTH_RANGE)


def validate(model: nn.Module) -> dict[str, float]:
    """Depth metrics on rooms that no training sees."""
    return evaluate_rooms(model, validation_rooms(), depth_range=DEPTH_RANGE)


def validation_rooms() -> Rooms:
    """Three views of rooms whose seeds no training uses."""
    return Rooms(12, seed=VALIDATION_SEED, num_views=3, image_size=(144, 192))
