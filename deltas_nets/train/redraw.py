"""Train the stage that redraws; nothing else of the network changes.

The network makes maps of rooms. They become maps as several frames would have agreed on, and the
stage learns to draw them as the rooms are. The command is `deltas redraw`.
"""

import json
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from deltas_nets.config import LossConfig
from deltas_nets.config.redraw import RedrawConfig
from deltas_nets.config.schedule import rate_factor
from deltas_nets.datasets.agreed_maps import agreed_like
from deltas_nets.errors import UserError
from deltas_nets.losses.losses import training_losses
from deltas_nets.network.deltas import Deltas
from deltas_nets.network.encoded import Encoded
from deltas_nets.network.known_depth import KnownDepth
from deltas_nets.network.lite.encoder import LiteEncoder
from deltas_nets.network.lite.redraw import Redraw
from deltas_nets.network.prediction import DepthPrediction
from deltas_nets.outputs.atomic_files import check_writable
from deltas_nets.train.average import RunningAverage
from deltas_nets.train.batches import Batch, BatchMaker
from deltas_nets.train.loader import room_loader
from deltas_nets.train.step import DEPTH_RANGE
from deltas_nets.weights_file import (
    check_new_weights,
    load_model,
    read_metadata,
    save_weights,
    weights_file,
)

__all__ = ["RedrawConfig", "learns", "train_redraw", "with_redraw"]

LOSS = LossConfig(detector=0, match=0, point=0, posterior=0, confidence=0, spread=0)
"""Of the map alone; the deviation stays that of the agreement."""
AVERAGE, WARMUP, CLIP = 0.98, 20, 1.0
LOGGED = 20
DIVERGED = 2.0
"""Times the error before."""
_OF_OTHER_WEIGHTS = ("format", "network", "torch")
_PLACES = ("out", "init", "cache", "log", "workers", "save_every")


class Lesson(NamedTuple):
    """A step's rooms.

    Attributes:
        batch: images and truth.
        encoded: of the network.
        prediction: its own, of which the lessons are made.
        agreed: ``(B, 1, H, W)`` the maps that are to be drawn anew.
    """

    batch: Batch
    encoded: Encoded
    prediction: DepthPrediction
    agreed: KnownDepth


def train_redraw(
    config: RedrawConfig,
    *,
    device: str | torch.device = "cpu",
    overwrite: bool = False,
    report: Callable[[str], None] = lambda _: None,
) -> Path:
    """Train the stage and write the network with it, every few steps.

    Args:
        config: what to do.
        device: where to compute.
        overwrite: replace ``config.out`` if it exists.
        report: called after every step.

    Returns:
        The weights file.

    Raises:
        UserError: a file is missing or holds another network, or exists already, before anything is
            computed; or training diverged.
    """
    check_new_weights(config.out, overwrite=overwrite)
    if config.log is not None:
        check_writable(config.log.parent)
    model = with_redraw(load_model(config.init).to(device), weights_file(config.init))
    assert model.redraw is not None
    before = read_metadata(weights_file(config.init))
    average = RunningAverage(model, AVERAGE)
    optimizer = torch.optim.AdamW(model.redraw.parameters(), weight_decay=1e-4)
    for step, lesson in enumerate(lessons(model, config, device)):
        rate = config.learning_rate * rate_factor(step, config.steps, warmup=WARMUP)
        for group in optimizer.param_groups:
            group["lr"] = rate
        said = learns(model, lesson, optimizer)
        average.update(model, step)
        _note(config, step, said)
        done = step + 1
        if done % config.save_every == 0 or done == config.steps:
            _check(said, config)
            averaged = average.model
            assert isinstance(averaged, Deltas)
            save_weights(config.out, averaged, record_of(config, before, done))
        report(f"step {done} of {config.steps}")
    return config.out


def with_redraw(model: Deltas, source: Path) -> Deltas:
    """The same network with a stage that redraws, which starts as its densifier if it has none.

    Everything else is frozen.
    """
    if not isinstance(model.encoder, LiteEncoder):
        raise UserError("only deltas-small has maps to redraw", source, "use --init")
    if model.redraw is None:
        device = next(model.parameters()).device
        with torch.random.fork_rng(devices=[]):
            wider = Deltas(replace(model.config, redraws=True)).to(device)
        wider.load_state_dict(model.state_dict(), strict=False)
        assert isinstance(wider.redraw, Redraw)
        wider.redraw.densifier.load_state_dict(model.densifier.state_dict())
        model = wider
    model.eval().requires_grad_(False)
    assert model.redraw is not None
    model.redraw.requires_grad_(True)
    return model


@torch.no_grad()
def _lesson(model: Deltas, batch: Batch, config: RedrawConfig, step: int) -> Lesson:
    encoded = model.encode(batch.images)
    size = (batch.images.shape[-2], batch.images.shape[-1])
    prediction = model.from_encoded(
        encoded,
        batch.views,
        DEPTH_RANGE,
        image_size=size,
        num_keypoints=config.num_keypoints,
        shift=batch.shift,
    )
    own = KnownDepth(prediction.depth, prediction.std / prediction.depth)
    random = torch.Generator().manual_seed(1_000_003 * config.seed + step)
    return Lesson(batch, encoded, prediction, agreed_like(own, batch.depth[:, :1], random))


def lessons(
    model: Deltas, config: RedrawConfig, device: str | torch.device = "cpu"
) -> Iterator[Lesson]:
    """What each step learns from."""
    of_rooms = config.of_rooms()
    make = BatchMaker(of_rooms)
    for step, rooms in enumerate(room_loader(of_rooms, start=0, stop=config.steps)):
        on_device = rooms.map(lambda tensor: tensor.to(device))
        yield _lesson(model, make(on_device, step), config, step)


def learns(model: Deltas, lesson: Lesson, optimizer: torch.optim.Optimizer) -> dict[str, float]:
    """A step; what the maps' relative error was before and after they were drawn anew."""
    batch, encoded, prediction, agreed = lesson
    assert model.redraw is not None
    drawn = model.redraw(encoded.features, agreed)
    depth = drawn.log_depth[0].exp()
    evidence = prediction.evidence._replace(dense=drawn)
    losses = training_losses(
        prediction._replace(depth=depth, evidence=evidence),
        batch.images,
        batch.true_views,
        batch.depth,
        LOSS,
        depth_range=DEPTH_RANGE,
    )
    optimizer.zero_grad()
    losses.total.backward()  # type: ignore[no-untyped-call]
    norm = torch.nn.utils.clip_grad_norm_(model.redraw.parameters(), CLIP)
    if bool(norm.isfinite()):  # a bad batch must not end a training
        optimizer.step()
    truth = batch.depth[:, :1]
    return {
        "loss": float(losses.total.detach()),
        "gradient": float(losses.terms["gradient"].detach()),
        "abs_rel_agreed": _abs_rel(agreed.depth, truth),
        "abs_rel_redrawn": _abs_rel(depth.detach(), truth),
    }


def _abs_rel(depth: Tensor, truth: Tensor) -> float:
    near, far = DEPTH_RANGE
    known = (truth > near) & (truth < far)
    return float(((depth - truth).abs() / truth)[known].mean())


def _note(config: RedrawConfig, step: int, said: dict[str, float]) -> None:
    if config.log is not None and ((step + 1) % LOGGED == 0 or step + 1 == config.steps):
        line = {"step": step + 1} | {name: round(value, 5) for name, value in said.items()}
        with config.log.open("a", encoding="utf-8") as opened:
            opened.write(json.dumps(line) + "\n")


def _check(said: dict[str, float], config: RedrawConfig) -> None:
    if not said["abs_rel_redrawn"] <= DIVERGED * said["abs_rel_agreed"]:
        what = "training diverged: maps that are drawn anew are twice as wrong"
        raise UserError(what, f"--learning-rate {config.learning_rate:g}", "give a lower one")


def record_of(config: RedrawConfig, before: dict[str, str], step: int) -> dict[str, str]:
    """Where the weights come from: the network's record, and that of the stage.

    Args:
        config: of this training.
        before: the record of the weights that it started from.
        step: how many are done.
    """
    kept = {name: value for name, value in before.items() if name not in _OF_OTHER_WEIGHTS}
    own: dict[str, Any] = {
        field.name: getattr(config, field.name) for field in fields(RedrawConfig)
    }
    public = {name: value for name, value in own.items() if name not in _PLACES}
    trained = json.dumps(public)
    earlier = [before["redraw_config"]] if "redraw_config" in before else []
    return kept | {
        "redraw_config": "; ".join([*earlier, trained]),
        "redraw_step": str(step),
        "redraw_seed": str(config.seed),
    }
