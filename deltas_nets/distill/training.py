"""Distil the interest-point detector from a teacher; nothing else of the network changes.

The teacher looks at every picture of a pool from several sides and keeps what it finds from most.
The student sees the picture as other cameras would have taken it, and learns to find the same
points. Its encoder is frozen, so that it runs once over the pool as well; what is trained is the
head on top, in seconds per thousand steps. The paper distils from SuperPoint in the same way
(section 3.1). The command is `deltas distill`.
"""

import json
from collections import deque
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from deltas_nets.config.distill import DistillConfig
from deltas_nets.config.schedule import rate_factor
from deltas_nets.distill.labels import hard_labels, soft_labels
from deltas_nets.distill.lessons import Lessons, prepare
from deltas_nets.distill.pictures import FIRST_ROOM, IMAGE_SIZE, NUM_ROOMS
from deltas_nets.distill.teachers import LICENCES, load_teacher
from deltas_nets.errors import UserError
from deltas_nets.network.deltas import Deltas
from deltas_nets.network.features import Features
from deltas_nets.network.lite.encoder import LiteEncoder
from deltas_nets.outputs.atomic_files import check_writable
from deltas_nets.weights_file import (
    check_new_weights,
    load_model,
    read_metadata,
    save_weights,
    weights_file,
    with_last,
)

__all__ = ["DistillConfig", "distill", "record_of", "train_detector", "with_fine_branch"]

RECENT = 200
"""Steps whose mean loss is recorded: a step's own depends on which pictures it drew."""
DIVERGED = 2.0
"""Times the first loss, which is that of a detector that knows something."""
_OF_OTHER_WEIGHTS = ("format", "network", "torch", "calibration")
_PLACES = ("teacher_weights", "out", "init", "cache")


class Learned(NamedTuple):
    """Losses of a training.

    Attributes:
        first: ``()`` of the first step.
        last: ``()`` mean of the last 200 steps, or of all if there are fewer.
    """

    first: Tensor
    last: Tensor


def distill(
    config: DistillConfig,
    *,
    device: str | torch.device = "cpu",
    overwrite: bool = False,
    report: Callable[[str], None] = lambda _: None,
) -> Path:
    """Prepare lessons, train the head, write the network.

    Args:
        config: what to do.
        device: where teacher and student compute. Pictures and their light are made on the host,
            so that they are the same whatever it is.
        overwrite: replace ``config.out`` if it exists.
        report: called after each of ``config.num_images`` pictures and ``config.steps`` steps.

    Returns:
        The weights file; its record holds the loss of the last steps as ``detector_loss``.

    Raises:
        UserError: a file is missing or holds something else, exists already or cannot be written;
            nothing has been computed yet.

    Example:
        >>> file = Path("aliked-n16.pth")  # doctest: +SKIP
        >>> config = DistillConfig("aliked", file, Path("mine.safetensors"))  # doctest: +SKIP
        >>> distill(config, report=print)  # doctest: +SKIP
        PosixPath('mine.safetensors')
    """
    _check_places(config, overwrite=overwrite)
    teacher = load_teacher(config.teacher, config.teacher_weights).to(device)
    source = weights_file(config.init)
    model = load_model(config.init)
    encoder = model.encoder
    if not isinstance(encoder, LiteEncoder):
        raise UserError("only deltas-small has a detector to distil into", source, "use --init")
    if config.fine_width and not model.config.detector.fine_width:
        model = with_fine_branch(model, config)
    model.to(device)
    # The encoder of before has the same weights as the wider network's.
    lessons = prepare(encoder.to(device), teacher, config, report=report)
    learned = train_detector(model, lessons, config, report=report)
    check_learned(learned, config)
    model.calibration.reset()  # it was fitted to the errors of other points
    save_weights(config.out, model, record_of(config, read_metadata(source), learned.last))
    return config.out


def _check_places(config: DistillConfig, *, overwrite: bool) -> None:
    """Whether what is written can be, before an hour's work."""
    check_new_weights(config.out, overwrite=overwrite)
    if config.cache is not None:
        if config.cache.is_file():
            what = "this is a file, not a folder"
            raise UserError(what, config.cache, "name a folder with --cache")
        check_writable(config.cache)


def with_fine_branch(model: Deltas, config: DistillConfig) -> Deltas:
    """The same network with a new branch in its detector, which changes nothing yet."""
    detector = replace(model.config.detector, fine_width=config.fine_width)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        wider = Deltas(replace(model.config, detector=detector))
    wider.load_state_dict(model.state_dict(), strict=False)
    return wider.eval()


def train_detector(
    model: Deltas,
    lessons: Lessons,
    config: DistillConfig,
    *,
    report: Callable[[str], None] = lambda _: None,
) -> Learned:
    """Train the detector head in place; every other weight and statistic stays as it is.

    Args:
        model: comes back in evaluation mode.
        lessons: what to learn from, on the model's device.
        config: steps, rate, kind of labels, seed.
        report: called after each step.

    Returns:
        The losses.
    """
    encoder = model.encoder
    assert isinstance(encoder, LiteEncoder)
    model.eval().requires_grad_(False)
    model.detector.train().requires_grad_(True)
    optimizer = torch.optim.AdamW(model.detector.parameters(), weight_decay=1e-4)
    random = torch.Generator().manual_seed(config.seed + 1)
    shape = (config.steps, config.batch_size)
    # Of all steps at once: a copy in every step would wait for the device.
    order = torch.randint(len(lessons.scores), shape, generator=random).to(lessons.scores.device)
    recent: deque[Tensor] = deque(maxlen=RECENT)
    first = torch.full((), torch.inf)
    for step, chosen in enumerate(order):
        for group in optimizer.param_groups:
            group["lr"] = config.learning_rate * rate_factor(step, config.steps, warmup=100)
        batch = Lessons(*(part[chosen].float() for part in lessons))
        features = _features(encoder, batch)
        logits = model.detector(features, image_size=IMAGE_SIZE, num_keypoints=8).logits
        loss = F.cross_entropy(logits, _targets(batch.scores, config))
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        recent.append(loss.detach())
        first = loss.detach() if step == 0 else first
        report(f"step {step + 1} of {config.steps}")
    model.eval()
    return Learned(first, torch.stack(list(recent)).mean())


def check_learned(learned: Learned, config: DistillConfig) -> None:
    """Raise ``UserError`` if training diverged."""
    if not bool(learned.last <= DIVERGED * learned.first):
        first, last = (float(loss) for loss in learned)
        what = f"training diverged: the loss went from {first:.3g} to {last:.3g}"
        raise UserError(what, f"--learning-rate {config.learning_rate:g}", "give a lower one")


def _features(encoder: LiteEncoder, batch: Lessons) -> Features:
    """Features of one view each; the maps at 1/2 and 1/4, which no detector reads, are empty."""
    unread = batch.eighth.new_empty(len(batch.eighth), 1, 0, 0, 0)
    with torch.no_grad():
        fine = encoder.fine(batch.images / 255)  # large to keep, and one layer to compute
    return Features(fine[:, None], unread, unread, batch.eighth[:, None], batch.sixteenth[:, None])


def _targets(scores: Tensor, config: DistillConfig) -> Tensor:
    if config.labels == "hard":
        return hard_labels(scores, threshold=config.threshold)
    return soft_labels(scores, gain=config.gain)


def record_of(config: DistillConfig, before: dict[str, str], loss: Tensor) -> dict[str, str]:
    """Where the weights come from: the network's record, and the detector's own.

    Args:
        config: of this distillation.
        before: the record of the weights that it started from.
        loss: ``()`` of the last steps.
    """
    kept = {k: v for k, v in before.items() if k not in _OF_OTHER_WEIGHTS}
    origin = before.get("origin", "unknown weights")
    # Of a teacher that taught before, something is left.
    licences, licence = before.get("detector_teacher_licence", ""), LICENCES[config.teacher]
    return kept | {
        "origin": with_last(origin, f"detector distilled from {config.teacher}"),
        "detector_teacher": config.teacher,
        "detector_teacher_file": config.teacher_weights.name,
        "detector_teacher_licence": with_last(licences, licence),
        "detector_data": f"{config.num_images} pictures: {_pictures(config)}",
        "detector_config": json.dumps(_public(config)),
        "detector_steps": str(config.steps),
        "detector_seed": str(config.seed),
        "detector_loss": f"{float(loss):.4f}",
    }


def _pictures(config: DistillConfig) -> str:
    rooms = f"views of procedural rooms {FIRST_ROOM}..{FIRST_ROOM + NUM_ROOMS}"
    photographs = "crops of photographs of scikit-image"
    if config.picture_share in (0, 1):
        return photographs if config.picture_share else rooms
    return f"{rooms}, and {photographs}"


def _public(config: DistillConfig) -> dict[str, Any]:
    """The settings without where files are, which is the machine's and private."""
    own = {field.name: getattr(config, field.name) for field in fields(DistillConfig)}
    return {name: value for name, value in own.items() if name not in _PLACES}
