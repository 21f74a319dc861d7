"""What a distillation of the detector depends on."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from deltas_nets.config.checks import check_at_least, check_positive, check_seed


@dataclass(frozen=True)
class DistillConfig:
    """Train the detector head of a network to find a teacher's points."""

    teacher: Literal["superpoint", "aliked", "disk", "xfeat", "deltas"]
    """Whose points are wanted; deltas is a network of ours, perhaps the one that learns: what it
    finds from many sides is steadier than what it finds from one."""
    teacher_weights: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """The teacher's published weights; of deltas also a shipped network's name."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """Weights file to write, .safetensors: the network with its new detector."""
    init: str = "deltas-small"
    """The network to start from: a shipped one, or a weights file of `deltas train`."""
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
    0.35 MB of the device's memory."""
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
    cache: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
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
