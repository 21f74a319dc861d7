"""Train the stage that redraws; nothing else of the network changes.

The network makes maps of rooms, and they hear each other as those of a capture do. The stage learns
to draw them as the rooms are. The command is `deltas redraw`.
"""

import copy
import hashlib
import json
import tempfile
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils.data import DataLoader

from deltas_nets.config import LossConfig
from deltas_nets.config.redraw import RedrawConfig
from deltas_nets.config.schedule import rate_factor
from deltas_nets.datasets.workers import leave_to_the_parent
from deltas_nets.errors import UserError
from deltas_nets.evaluate.rooms import DisturbedRooms
from deltas_nets.losses.losses import map_losses
from deltas_nets.network.deltas import Deltas
from deltas_nets.network.known_depth import KnownDepth
from deltas_nets.network.lite.encoder import LiteEncoder
from deltas_nets.network.lite.redraw import Redraw
from deltas_nets.outputs.atomic_files import check_file, check_writable, remove_abandoned
from deltas_nets.rooms import Rooms
from deltas_nets.rooms.rooms import VERSION
from deltas_nets.train.average import RunningAverage
from deltas_nets.train.heard_rooms import HeardRooms
from deltas_nets.train.step import DEPTH_RANGE
from deltas_nets.weights_file import (
    check_new_weights,
    load_model,
    read_metadata,
    save_weights,
    sha256_of,
    weights_file,
)

__all__ = ["Lesson", "RedrawConfig", "learns", "lesson", "train_redraw", "with_redraw"]

LOSS = LossConfig()
AVERAGE, WARMUP, CLIP = 0.98, 20, 1.0
LOGGED = 20
DIVERGED = 2.0
"""Times the error before."""
_OF_OTHER_WEIGHTS = ("format", "network", "torch")
_PLACES = ("out", "init", "cache", "log", "workers", "save_every")


class Lesson(NamedTuple):
    """Views of a step, of several rooms.

    Attributes:
        images: ``(B, 3, H, W)`` in [0, 1].
        agreed: ``(B, 1, H, W)`` the maps that are to be drawn anew.
        depth: ``(B, 1, H, W)`` true, metres.
    """

    images: Tensor
    agreed: KnownDepth
    depth: Tensor


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
        overwrite: replace ``config.out`` and ``config.log`` if they exist.
        report: called after every room and every step.

    Returns:
        The weights file.

    Raises:
        UserError: a file is missing or holds another network, or exists already, before anything is
            computed; or training diverged.
    """
    check_new_weights(config.out, overwrite=overwrite)
    if config.log is not None:
        check_file(config.log)
        if config.log.exists() and not overwrite:
            raise UserError("the file exists", config.log, "add --overwrite or name a new --log")
    if config.cache is not None:
        check_writable(config.cache)
    model = with_redraw(load_model(config.init).to(device), weights_file(config.init))
    assert model.redraw is not None
    before = read_metadata(weights_file(config.init))
    if config.log is not None:
        config.log.parent.mkdir(parents=True, exist_ok=True)
        config.log.write_text("")  # every training begins anew
    with tempfile.TemporaryDirectory() as temporary:
        heard = heard_rooms(model, config, config.cache or Path(temporary))
        for index in DataLoader(
            heard,
            batch_size=None,
            num_workers=config.workers,
            worker_init_fn=leave_to_the_parent,
        ):
            report(f"room {index + 1} of {config.num_rooms}")
        _learn(model, heard, config, device, before, report)
    return config.out


def _learn(
    model: Deltas,
    heard: HeardRooms,
    config: RedrawConfig,
    device: str | torch.device,
    before: dict[str, str],
    report: Callable[[str], None],
) -> None:
    assert model.redraw is not None
    average = RunningAverage(model, AVERAGE)
    optimizer = torch.optim.AdamW(model.redraw.parameters(), weight_decay=1e-4)
    for step in range(config.steps):
        rate = config.learning_rate * rate_factor(step, config.steps, warmup=WARMUP)
        for group in optimizer.param_groups:
            group["lr"] = rate
        said = learns(model, lesson(heard, config, step, device), optimizer)
        average.update(model, step)
        _note(config, step, said)
        done = step + 1
        if done % config.save_every == 0 or done == config.steps:
            _check(said, config)
            averaged = average.model
            assert isinstance(averaged, Deltas)
            save_weights(config.out, averaged, record_of(config, before, done))
        report(f"step {done} of {config.steps}")


def heard_rooms(model: Deltas, config: RedrawConfig, folder: Path) -> HeardRooms:
    """The rooms that a training learns from; made on the host.

    Args:
        model: the network, from ``config.init``.
        config: what rooms, and how they are seen.
        folder: gets a folder of files for what both decide, so that no others are ever read.
    """
    height, width = (max(side) for side in zip(*config.sizes, strict=True))
    seen = (config.num_views, config.num_sources, height, width, config.close_ups)
    decides = (sha256_of(weights_file(config.init)), VERSION, config.first_room, *seen)
    name = hashlib.sha256(repr(decides).encode()).hexdigest()[:12]
    rooms = Rooms(
        config.num_rooms,
        seed=config.first_room,
        num_views=config.num_views,
        image_size=(height, width),
        close_ups=config.close_ups,
    )
    remove_abandoned(folder / name)
    on_host = copy.deepcopy(model).cpu()  # its processes cannot share another device
    return HeardRooms(
        DisturbedRooms(rooms),
        on_host,
        folder / name,
        num_sources=config.num_sources,
        seed=config.first_room,
    )


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


def lesson(
    heard: HeardRooms, config: RedrawConfig, step: int, device: str | torch.device = "cpu"
) -> Lesson:
    """What a step learns from: views of rooms drawn by chance, half of them mirrored."""
    random = np.random.default_rng((config.seed, step))
    height, width = config.sizes[random.integers(len(config.sizes))]
    drawn = []
    for room in random.integers(config.num_rooms, size=config.batch_size):
        view = heard.view(int(room), int(random.integers(config.num_views)))
        parts = (view.image, *view.agreed, view.depth)
        drawn.append([part.flip(-1) for part in parts] if random.random() < 0.5 else parts)
    image, *maps = (torch.stack(parts).to(device) for parts in zip(*drawn, strict=True))
    image = F.interpolate(image, size=(height, width), mode="bilinear", antialias=True)
    depth, deviation, truth = (
        F.interpolate(part, size=(height, width), mode="nearest-exact") for part in maps
    )
    return Lesson(image, KnownDepth(depth, deviation), truth)


def learns(model: Deltas, lesson: Lesson, optimizer: torch.optim.Optimizer) -> dict[str, float]:
    """A step; what the maps' relative error was before and after they were drawn anew."""
    images, agreed, truth = lesson
    assert model.redraw is not None
    with torch.no_grad():
        features = model.encode(images[:, None]).features
    drawn = model.redraw(features, agreed)
    losses = map_losses(drawn, images, truth, LOSS, depth_range=DEPTH_RANGE)
    optimizer.zero_grad()
    losses.total.backward()  # type: ignore[no-untyped-call]
    norm = torch.nn.utils.clip_grad_norm_(model.redraw.parameters(), CLIP)
    if bool(norm.isfinite()):  # a bad batch must not end a training
        optimizer.step()
    return {
        "loss": float(losses.total.detach()),
        "gradient": float(losses.terms["gradient"].detach()),
        "abs_rel_agreed": _abs_rel(agreed.depth, truth),
        "abs_rel_redrawn": _abs_rel(drawn.log_depth[0].detach().exp(), truth),
        "spread": float(losses.terms["spread"].detach()),
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
