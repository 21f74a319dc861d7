"""The training loop: one step after another, with everything that survives a kill."""

import json
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from torch import Tensor, nn

from deltas_nets.config import TrainConfig
from deltas_nets.data.synthetic import Rooms
from deltas_nets.errors import UserError
from deltas_nets.evaluate.rooms import evaluate_rooms
from deltas_nets.losses import Losses, training_losses
from deltas_nets.network.deltas import Deltas
from deltas_nets.pretrained import load_weights, read_metadata
from deltas_nets.train.average import RunningAverage
from deltas_nets.train.batches import Batch, BatchMaker, room_loader
from deltas_nets.train.checkpoint import RunState, load_run, save_run

if TYPE_CHECKING:
    from lightning_fabric import Fabric

DEPTH_RANGE = (0.5, 10.0)
VALIDATION_SEED = 0  # of the first of the rooms that no training sees


@dataclass(frozen=True)
class Start:
    """What a run starts from.

    Attributes:
        encoder: an EfficientNet-Lite0 checkpoint for the encoder.
        init: a weights file for the whole network.
        step: the first step, for a schedule that goes on from ``init``.
        resume: go on from the checkpoint in the run's folder.
    """

    encoder: Path | None = None
    init: Path | None = None
    step: int = 0
    resume: bool = False


def fit(
    config: TrainConfig,
    folder: Path,
    start: Start,
    *,
    checkpoint_every: int = 200,
    validate_every: int = 500,
    stop: int | None = None,
    report: Callable[[str], None] = print,
) -> Path:
    """Train a network.

    Args:
        config: the whole run.
        folder: gets config.json, checkpoint.pt, weights.safetensors (the running average) and
            log.jsonl.
        start: what to start from.
        checkpoint_every: steps between checkpoints.
        validate_every: steps between evaluations on held-out rooms.
        stop: end after this step, to be resumed later; the schedule stays that of the config.
        report: where messages go.

    Returns:
        The weights file.

    Raises:
        UserError: a file to start from is missing or does not fit; training diverged.
    """
    fabric = _fabric(config)
    torch.manual_seed(config.seed)
    state, origin = _starting_state(config, folder, start)
    model, optimizer = fabric.setup(state.model, state.optimizer)
    maker = BatchMaker(config)
    folder.mkdir(parents=True, exist_ok=True)
    step, last = state.step, min(config.steps, stop or config.steps)
    loader = room_loader(config, start=step, stop=last)

    def save() -> None:
        save_run(folder, config, state._replace(step=step), origin=origin)

    if not start.resume:
        save()  # before the first step, so that a run can always be resumed
    with _progress() as progress, (folder / "log.jsonl").open("a") as log, _saving_if_stopped(save):
        bar = progress.add_task("training", total=config.steps, completed=step, loss="")
        for rooms in loader:
            began = time.perf_counter()
            for group in optimizer.param_groups:
                group["lr"] = group["peak"] * learning_rate_factor(step, config)
            losses = _step(model, optimizer, fabric.to_device(maker(rooms, step)), config, fabric)
            state.average.update(state.model, step)
            step += 1
            if step % 20 == 0 or step == last:
                entry = _log_entry(step, losses, time.perf_counter() - began)
                print(json.dumps(entry), file=log, flush=True)
                progress.update(bar, loss=f"loss {entry['total']:.3f}")
                if not math.isfinite(entry["total"]):
                    what = f"training diverged at step {step}"
                    raise UserError(what, folder, "lower --learning-rate")
            progress.update(bar, completed=step)
            if step % checkpoint_every == 0 or step == last:
                save()
            if step % validate_every == 0 or step == last:
                validation = validate(state.average.model)
                print(json.dumps({"step": step, "validation": validation}), file=log, flush=True)
                report(f"step {step}: held-out rooms {_in_words(validation)}")
    return folder / "weights.safetensors"


@contextmanager
def _saving_if_stopped(save: Callable[[], None]) -> Iterator[None]:
    """Ctrl-C costs no steps."""
    try:
        yield
    except KeyboardInterrupt:
        save()
        raise


def learning_rate_factor(step: int, config: TrainConfig) -> float:
    """Linear warm-up, then half a cosine down to a hundredth."""
    warm = min(1.0, (step + 1) / max(1, min(config.warmup, config.steps // 10)))
    return warm * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * step / config.steps)))


def validate(model: nn.Module) -> dict[str, float]:
    """Depth metrics on rooms that no training sees."""
    return evaluate_rooms(model, validation_rooms(), depth_range=DEPTH_RANGE)


def validation_rooms() -> Rooms:
    """Three views of rooms whose seeds no training uses."""
    return Rooms(12, seed=VALIDATION_SEED, num_views=3, image_size=(144, 192))


def make_optimizer(model: Deltas, config: TrainConfig) -> torch.optim.Optimizer:
    """AdamW; the pretrained encoder learns at a fifth of the rate."""
    pretrained = [
        parameter
        for name, parameter in model.encoder.named_parameters()
        if not name.startswith("fine.")
    ]
    known = {id(parameter) for parameter in pretrained}
    fresh = [parameter for parameter in model.parameters() if id(parameter) not in known]
    rate = config.learning_rate
    return torch.optim.AdamW(
        [{"params": pretrained, "peak": rate / 5}, {"params": fresh, "peak": rate}],
        lr=rate,
        weight_decay=config.weight_decay,
    )


def _step(
    model: nn.Module,
    optimizer: torch.optim.Optimizer,
    batch: Batch,
    config: TrainConfig,
    fabric: "Fabric",
) -> Losses:
    # Not Fabric's mixed precision: it would round the cameras to half precision as well.
    mixed = config.precision == "bf16-mixed"
    with torch.autocast(batch.images.device.type, dtype=torch.bfloat16, enabled=mixed):
        prediction = model(
            batch.images,
            batch.views,
            DEPTH_RANGE,
            num_keypoints=config.num_keypoints,
            shift=batch.shift,
        )
    losses = training_losses(
        prediction,
        batch.images,
        batch.true_views,
        batch.depth,
        config.loss,
        depth_range=DEPTH_RANGE,
    )
    optimizer.zero_grad()
    fabric.backward(losses.total)
    fabric.clip_gradients(model, optimizer, max_norm=config.clip_gradient, error_if_nonfinite=False)
    if _all_finite(model):
        optimizer.step()
    return losses


def _all_finite(model: nn.Module) -> bool:
    """Whether the gradient is usable: one bad batch must not end a night's training."""
    gradients = [p.grad for p in model.parameters() if p.grad is not None]
    norms: list[Tensor] = list(torch._foreach_norm(gradients))
    return bool(torch.stack(norms).isfinite().all())


def _starting_state(config: TrainConfig, folder: Path, start: Start) -> tuple[RunState, str]:
    model = Deltas(config.network)
    origin = "random weights"
    if start.encoder is not None:
        model.encoder.load_pretrained(start.encoder)
        origin = "encoder from EfficientNet-Lite0 (Apache-2.0)"
    if start.init is not None:
        if not start.init.is_file():
            raise UserError("no such weights", start.init, "name a .safetensors file with --init")
        origin = read_metadata(start.init).get("origin", "unknown weights")
        load_weights(model, start.init)
    average = RunningAverage(model, config.average)
    state = RunState(model, average, make_optimizer(model, config), start.step)
    return load_run(folder, state) if start.resume else (state, origin)


def _fabric(config: TrainConfig) -> "Fabric":
    try:
        from lightning_fabric import Fabric
    except ImportError:
        raise UserError(
            "training needs lightning-fabric", "deltas-depth", 'pip install "deltas-depth[train]"'
        ) from None
    fabric = Fabric(accelerator="auto", devices=1)
    fabric.launch()
    return fabric


def _log_entry(step: int, losses: Losses, seconds: float) -> dict[str, float]:
    values = {name: float(term.detach()) for name, term in losses._asdict().items()}
    return {"step": step, **values, "seconds": seconds}


def _in_words(metrics: dict[str, float]) -> str:
    words = {"abs_rel": "Abs Rel", "delta1": "delta<1.25", "sparse": "median of points"}
    return ", ".join(f"{words[name]} {value:.4f}" for name, value in metrics.items())


def _progress() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[loss]}"),
        TimeRemainingColumn(),
    )
