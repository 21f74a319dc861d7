"""Distil the interest-point detector from a teacher; nothing else of the network changes.

python -m deltas_nets.train.distill --teacher aliked --teacher-weights aliked-n16.pth --out FILE

The teacher looks at every picture of a pool from several sides and keeps what it finds from most.
The student sees the picture as other cameras would have taken it, and learns to find the same
points. Its encoder is frozen, so that it runs
once over the pool as well; what is trained is the head on top, in seconds per thousand steps.
The paper distils from SuperPoint in the same way (section 3.1).
"""

import math
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import torch
import torch.nn.functional as F
import tyro
from torch import Tensor

from deltas_nets.atomic_files import check_writable
from deltas_nets.config.checks import check_at_least, check_positive, check_seed
from deltas_nets.data.augment import Photometry
from deltas_nets.data.synthetic import Rooms
from deltas_nets.data.synthetic.textures import GROUNDS, PICTURES, load_picture
from deltas_nets.errors import UserError
from deltas_nets.network.deltas import Deltas
from deltas_nets.network.encoder import Encoder, Features
from deltas_nets.pretrained import DEFAULT, load_model, read_metadata, save_weights, weights_file
from deltas_nets.teachers import LICENCES, Teacher, load_teacher
from deltas_nets.teachers.adaptation import adapted_scores
from deltas_nets.teachers.labels import hard_labels, soft_labels

IMAGE_SIZE = (192, 256)
ROOM_VIEWS = 5
FIRST_ROOM, NUM_ROOMS = 1000, 2400  # as in training; validation rooms have seeds below 1000


@dataclass(frozen=True)
class DistillConfig:
    """Train the detector head of a network to find a teacher's points."""

    teacher: Literal["superpoint", "aliked", "disk", "xfeat"]
    """Whose points are wanted."""
    teacher_weights: Path
    """The teacher's published weights."""
    out: Path
    """The network with its new detector, a .safetensors file."""
    init: str = DEFAULT
    """The network to start from: a shipped one, or a weights file."""
    steps: int = 4000
    """Optimiser steps."""
    batch_size: int = 16
    """Pictures per step."""
    learning_rate: float = 3e-3
    """At the start; it falls to a hundredth along half a cosine."""
    num_images: int = 1500
    """Pictures that the teacher labels."""
    adaptation: int = 10
    """Ways in which the teacher looks at each of them, warped by random homographies: it keeps
    what it finds from most sides. 1: as it is."""
    looks: int = 2
    """Variants of every picture that the student sees: other light, noise, blur. One takes
    0.35 MB of memory."""
    picture_share: float = 0.3
    """Share of them cut from photographs that come with scikit-image; the others are views of
    procedural rooms."""
    labels: Literal["soft", "hard"] = "soft"
    """What the student learns: how good every point is, or where the points are."""
    gain: float = 2.0
    """soft: factor of the teacher's scores, which are small, the more so a mean of many looks."""
    fine_width: int = 16
    """Width of the detector's fine branch, if the network has none yet; 0 adds none."""
    threshold: float = 0.1
    """hard: weaker points of the teacher are none."""
    cache: Path | None = None
    """Folder that keeps rendered rooms; without it they are rendered."""
    seed: int = 0
    """Of everything random."""

    def __post_init__(self) -> None:
        check_at_least(1, self, "steps", "batch_size", "num_images", "looks", "adaptation")
        check_at_least(0, self, "fine_width", "threshold")
        check_positive(self, "learning_rate", "gain")
        check_seed(self)
        if not 0 <= self.picture_share <= 1:
            raise ValueError(f"picture_share must be within [0, 1], got {self.picture_share}")


class Lessons(NamedTuple):
    """What the head is trained with: N looks of the frozen encoder, and the teacher's answers.

    Attributes:
        images: ``(N, 3, H, W)`` uint8 as the student sees them.
        eighth: ``(N, 40, H/8, W/8)`` float16 features.
        sixteenth: ``(N, 112, H/16, W/16)`` float16 features.
        scores: ``(N, 1, H, W)`` float16 of the teacher.
    """

    images: Tensor
    eighth: Tensor
    sixteenth: Tensor
    scores: Tensor


def distill(config: DistillConfig, *, report: Callable[[str], None] = print) -> Path:
    """Prepare lessons, train the head, write the network.

    Returns:
        The weights file.

    Raises:
        UserError: a file is missing or holds something else, or cannot be written.
    """
    if config.out.suffix != ".safetensors":
        raise UserError("weights are .safetensors", config.out, "name such a file with --out")
    check_writable(config.out.parent)
    teacher = load_teacher(config.teacher, config.teacher_weights)
    source = weights_file(config.init)
    model = load_model(config.init)
    encoder = model.encoder
    if not isinstance(encoder, Encoder):
        raise UserError("only deltas-small has a detector to distil into", source, "use --init")
    if config.fine_width and not model.config.detector.fine_width:
        model = with_fine_branch(model, config)
    lessons = prepare(encoder, teacher, config, report=report)
    train_detector(model, lessons, config, report=report)
    save_weights(config.out, model, _record(config, read_metadata(source)))
    report(f"weights in {config.out}")
    return config.out


def with_fine_branch(model: Deltas, config: DistillConfig) -> Deltas:
    """The same network with a new branch in its detector, which changes nothing yet."""
    detector = replace(model.config.detector, fine_width=config.fine_width)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        wider = Deltas(replace(model.config, detector=detector))
    wider.load_state_dict(model.state_dict(), strict=False)
    return wider.eval()


def draw_pictures(config: DistillConfig) -> Iterator[Tensor]:
    """The pictures ``(3, H, W)`` uint8, a function of the config alone."""
    random = torch.Generator().manual_seed(config.seed)
    rooms = Rooms(
        NUM_ROOMS,
        seed=FIRST_ROOM,
        num_views=ROOM_VIEWS,
        image_size=IMAGE_SIZE,
        cache_dir=config.cache,
    )
    photographs = [load_picture(name) for name in (*PICTURES, *GROUNDS)]
    arrays = [torch.frombuffer(bytearray(p.tobytes()), dtype=torch.uint8) for p in photographs]
    sizes = [(p.height, p.width) for p in photographs]
    images = [a.view(*s, 3).permute(2, 0, 1) for a, s in zip(arrays, sizes, strict=True)]
    for _ in range(config.num_images):
        if float(torch.rand((), generator=random)) < config.picture_share:
            chosen = int(torch.randint(len(images), (), generator=random))
            picture = _random_crop(images[chosen], random)
        else:
            room = int(torch.randint(NUM_ROOMS, (), generator=random))
            view = int(torch.randint(ROOM_VIEWS, (), generator=random))
            picture = rooms[room].images[view]
        # Before the teacher looks: in a mirror it finds other points, not the same mirrored.
        yield picture.flip(-1) if float(torch.rand((), generator=random)) < 0.5 else picture


def _random_crop(image: Tensor, random: torch.Generator) -> Tensor:
    """A part of a photograph, of our shape, between a third and all of what fits."""
    height, width = image.shape[-2:]
    scale = min(height / IMAGE_SIZE[0], width / IMAGE_SIZE[1])
    scale *= 0.35 + 0.65 * float(torch.rand((), generator=random))
    rows, columns = (max(1, int(scale * side)) for side in IMAGE_SIZE)
    top = int(torch.randint(height - rows + 1, (), generator=random))
    left = int(torch.randint(width - columns + 1, (), generator=random))
    part = image[None, :, top : top + rows, left : left + columns].float()
    resized = F.interpolate(part, size=IMAGE_SIZE, mode="bilinear", antialias=True)
    return resized[0].round().clamp(0, 255).to(torch.uint8)


@torch.no_grad()
def prepare(
    encoder: Encoder,
    teacher: Teacher,
    config: DistillConfig,
    *,
    report: Callable[[str], None] = print,
) -> Lessons:
    """Show every picture to the teacher, and ``config.looks`` variants of it to the encoder."""
    encoder.eval()
    photometry = Photometry()
    lessons: list[Lessons] = []
    for number, picture in enumerate(draw_pictures(config)):
        image = picture[None].float() / 255
        random = torch.Generator().manual_seed(config.seed * 1_000_003 + number)
        scores = adapted_scores(teacher, image, looks=config.adaptation, random=random).half()
        for look in range(config.looks):
            seed = config.seed * 1_000_003 + number * config.looks + look
            seen = photometry(image[:, None], seed)
            features = encoder(seen).of_anchor()
            kept = (features.eighth.half(), features.sixteenth.half())
            lessons.append(Lessons((255 * seen[:, 0]).round().to(torch.uint8), *kept, scores))
        if (number + 1) % 200 == 0:
            report(f"{number + 1} pictures of {config.num_images} labelled")
    return Lessons(*(torch.cat(parts) for parts in zip(*lessons, strict=True)))


def train_detector(
    model: Deltas, lessons: Lessons, config: DistillConfig, *, report: Callable[[str], None] = print
) -> None:
    """Train the detector head in place; every other weight and statistic stays as it is.

    Args:
        model: comes back in evaluation mode.
        lessons: what to learn from.
        config: steps, rate, kind of labels, seed.
        report: gets the loss now and then.
    """
    encoder = model.encoder
    assert isinstance(encoder, Encoder)
    model.eval().requires_grad_(False)
    model.detector.train().requires_grad_(True)
    optimizer = torch.optim.AdamW(model.detector.parameters(), weight_decay=1e-4)
    random = torch.Generator().manual_seed(config.seed + 1)
    recent = 0.0
    for step in range(config.steps):
        for group in optimizer.param_groups:
            group["lr"] = config.learning_rate * _rate_factor(step, config.steps)
        chosen = torch.randint(len(lessons.scores), (config.batch_size,), generator=random)
        batch = Lessons(*(part[chosen].float() for part in lessons))
        features = _features(encoder, batch)
        logits = model.detector(features, image_size=IMAGE_SIZE, num_keypoints=8).logits
        loss = F.cross_entropy(logits, _targets(batch.scores, config))
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        recent += float(loss.detach())
        if (step + 1) % 200 == 0:
            report(f"step {step + 1} of {config.steps}: loss {recent / 200:.4f}")
            recent = 0.0
    model.eval()


def _features(encoder: Encoder, batch: Lessons) -> Features:
    """As of one view each; the maps at 1/2 and 1/4 that no detector reads are left empty."""
    unread = batch.eighth.new_empty(len(batch.eighth), 1, 0, 0, 0)
    with torch.no_grad():
        fine = encoder.fine(batch.images / 255)  # large to keep, and one layer to compute
    return Features(fine[:, None], unread, unread, batch.eighth[:, None], batch.sixteenth[:, None])


def _targets(scores: Tensor, config: DistillConfig) -> Tensor:
    if config.labels == "hard":
        return hard_labels(scores, threshold=config.threshold)
    return soft_labels(scores, gain=config.gain)


def _rate_factor(step: int, steps: int) -> float:
    warm = min(1.0, (step + 1) / max(1, min(100, steps // 10)))
    return warm * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * step / steps)))


def _record(config: DistillConfig, before: dict[str, str]) -> dict[str, str]:
    """Where the weights come from: the network's record, and the detector's own."""
    kept = {k: v for k, v in before.items() if k not in ("format", "network", "torch")}
    origin = before.get("origin", "unknown weights")
    return kept | {
        "origin": f"{origin}; detector distilled from {config.teacher}",
        "detector_teacher": config.teacher,
        "detector_teacher_file": config.teacher_weights.name,
        "detector_teacher_licence": LICENCES[config.teacher],
        "detector_data": (
            f"{config.num_images} pictures: views of procedural rooms {FIRST_ROOM}.."
            f"{FIRST_ROOM + NUM_ROOMS}, and crops of photographs of scikit-image"
        ),
        "detector_adaptation": str(config.adaptation),
        "detector_steps": str(config.steps),
        "detector_seed": str(config.seed),
    }


def main() -> None:
    """Entry point of ``python -m deltas_nets.train.distill``."""
    config = tyro.cli(DistillConfig, description=__doc__)
    try:
        distill(config)
    except UserError as error:
        print(f"distill: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
