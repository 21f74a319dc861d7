"""What a detector is distilled with: looks of the frozen encoder, and the teacher's answers."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from deltas_nets.config.distill import DistillConfig
from deltas_nets.datasets.augment import Photometry
from deltas_nets.distill.adaptation import adapted_scores
from deltas_nets.distill.pictures import draw_pictures
from deltas_nets.distill.teachers import Teacher
from deltas_nets.network.lite.encoder import LiteEncoder


class Lessons(NamedTuple):
    """What the head is trained with: N looks of the frozen encoder, and the teacher's answers.

    Attributes:
        images: ``(N, 3, H, W)`` uint8 as the student sees them.
        eighth: ``(N, C, H/8, W/8)`` float16 features.
        sixteenth: ``(N, C, H/16, W/16)`` float16 features.
        scores: ``(N, 1, H, W)`` float16 of the teacher.
    """

    images: Tensor
    eighth: Tensor
    sixteenth: Tensor
    scores: Tensor


@torch.no_grad()
def prepare(
    encoder: LiteEncoder,
    teacher: Teacher,
    config: DistillConfig,
    *,
    report: Callable[[str], None] = lambda _: None,
) -> Lessons:
    """Show every picture to the teacher, and ``config.looks`` variants of it to the encoder.

    Args:
        encoder: stays in evaluation mode.
        teacher: on the same device, where the lessons stay too.
        config: how many pictures and variants, and their seed.
        report: called after each picture.
    """
    encoder.eval()
    device = next(encoder.parameters()).device
    photometry = Photometry()
    lessons: list[Lessons] = []
    for number, picture in enumerate(draw_pictures(config)):
        image = picture[None].float() / 255
        random = torch.Generator().manual_seed(config.seed * 1_000_003 + number)
        scores = adapted_scores(
            teacher, image.to(device), looks=config.adaptation, random=random
        ).half()
        for look in range(config.looks):
            seed = config.seed * 1_000_003 + number * config.looks + look
            # On the host: a GPU's generator would draw another light for the same seed.
            seen = photometry(image[:, None], seed).to(device)
            features = encoder(seen).of_anchor()
            kept = (features.eighth.half(), features.sixteenth.half())
            lessons.append(Lessons((255 * seen[:, 0]).round().to(torch.uint8), *kept, scores))
        report(f"picture {number + 1} of {config.num_images} labelled")
    return Lessons(*(torch.cat(parts) for parts in zip(*lessons, strict=True)))
