"""What a training run depends on: data and schedule, and the weights of its losses."""

from dataclasses import dataclass, field
from typing import Annotated, Literal, get_args

import tyro

from deltas_nets.config.checks import (
    check_at_least,
    check_positive,
    check_seed,
    check_share,
    check_unseen,
)
from deltas_nets.config.losses import LossConfig
from deltas_nets.config.network import NetworkConfig
from deltas_nets.config.scannet import ScanNetConfig
from deltas_nets.config.schedule import Schedule


@dataclass(frozen=True)
class DataConfig:
    """What to train on."""

    source: Annotated[
        Literal["rooms", "scannet"], tyro.conf.arg(name="data", prefix_name=False)
    ] = "rooms"
    """rooms are procedural, with exact depth; scannet is scene folders in ScanNet's layout below
    --root."""
    num_rooms: int = 4000
    """rooms: how many in an epoch."""
    seed: int = 1000
    """rooms: seed of the first one, 1000 or more: rooms that are measured on have those below."""
    close_ups: float = 0.0
    """rooms: share of them that are desks, shelves and floors from near by, enlarged as the network
    sees what is nearer than rooms are."""
    num_views: int = 5
    """rooms: views rendered of each; any of them can be the anchor."""
    height: int = 192
    """Height of the images that are rendered or read, pixels."""
    width: int = 256
    """Width of the images that are rendered or read, pixels."""
    cache: Annotated[str | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder that keeps rendered rooms, 7 bytes a pixel of every view, or ScanNet's poses, 0.15 KB
    a frame; without it they are rendered or read each time."""
    workers: int = 1
    """Processes that read or render ahead; 0 does it in the training process."""
    replay: int = 1
    """Steps in which a room that was rendered or read is used on average, in another light, and of
    rooms with other anchors and sources: for processors that learn faster than rooms are
    rendered."""
    shelf: int = 1
    """Rooms that each place of a step keeps in the memory of the device, to take one at random;
    about as many as --data.replay or more."""
    scannet: Annotated[ScanNetConfig, tyro.conf.arg(name="")] = field(default_factory=ScanNetConfig)

    def __post_init__(self) -> None:
        if self.source == "rooms" and self.scannet != ScanNetConfig():
            raise ValueError("--root and the other options of ScanNet need --data scannet")
        check_seed(self)
        if self.source == "rooms":
            check_unseen(self, "seed")
        check_at_least(0, self, "workers")
        check_at_least(1, self, "num_rooms")
        check_at_least(2, self, "num_views")
        check_at_least(32, self, "height", "width")
        if not 0 <= self.close_ups <= 1:
            raise ValueError(f"close_ups must be within [0, 1], got {self.close_ups}")
        if self.replay < 1 or self.shelf < 1:
            raise ValueError(
                f"replay and shelf must be at least 1, got {self.replay} and {self.shelf}"
            )


Stage = Literal["encoder", "detector", "descriptor", "matcher", "judge", "densifier"]
"""What a network consists of, by the name of its module."""


@dataclass(frozen=True)
class TrainConfig:
    """Everything a training run depends on."""

    network: NetworkConfig = field(default_factory=NetworkConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    data: DataConfig = field(default_factory=DataConfig)
    steps: int = 5000
    """Optimiser steps of the whole schedule."""
    sizes: tuple[tuple[int, int], ...] = ((144, 192), (144, 192), (192, 256))
    """(height, width) of the images of a step, drawn at random."""
    batch_size: int = 6
    """Rooms per step, of all processes together: their number changes no result."""
    accumulate: int = 1
    """Passes that a process takes over its part of a step, to need less memory; the result is
    that of one pass, for four tenths more time (batch norm sees the rooms of one pass)."""
    devices: int = 1
    """Processes on each machine, one a GPU; torchrun and fabric run decide it themselves."""
    num_nodes: int = 1
    """Machines; torchrun and fabric run decide it themselves."""
    sync_batchnorm: bool = True
    """Batch norm sees the rooms of all GPUs; with one, or on CPUs, nothing changes."""
    freeze: tuple[Stage, ...] = ()
    """Stages that stay as they are, their batch norm's statistics included."""
    freeze_batch_norm: bool = False
    """Batch norm keeps its mean and variance, as for fine-tuning with few rooms per step; its
    scale and shift still learn."""
    learning_rate: float = 2e-3
    """Peak of the schedule."""
    encoder_rate: float = 0.2
    """The encoder, which is pretrained, learns at this share of it."""
    schedule: Schedule = "cosine"
    """After the warm-up: half a cosine down to a hundredth, or the peak to the end."""
    weight_decay: float = 1e-4
    """Of AdamW."""
    warmup: int = 100
    """Steps until the peak; a tenth of all at most."""
    min_views: int = 2
    """Fewest views per step, the anchor included; their number is drawn at random."""
    max_views: int = 5
    """Most views per step."""
    num_keypoints: int = 320
    """Points per image in training."""
    teacher: Literal["superpoint", "aliked", "disk", "xfeat", "deltas"] | None = None
    """Whose interest points the detector learns to find (the paper: SuperPoint's), with weights
    from --teacher-weights; Shi-Tomasi corners without one."""
    pose_noise: Annotated[tuple[float, float], tyro.conf.arg(metavar="METRES RADIANS")] = (
        0.004,
        0.0015,
    )
    """Standard deviation of the sources' pose errors, metres and radians, for a common tracker:
    each room's has a quarter to twice as much."""
    clip_gradient: float = 5.0
    """Largest norm of the gradient."""
    average: float = 0.995
    """Decay of the running average of the weights, which is what is evaluated and shipped."""
    seed: int = 0
    """Of everything random."""
    precision: Literal["32-true", "bf16-mixed"] = "32-true"
    """bf16-mixed is faster where the processor has bfloat16; geometry stays in float32."""

    def __post_init__(self) -> None:
        most = self.data.num_views if self.data.source == "rooms" else self.max_views
        if not 2 <= self.min_views <= self.max_views <= most:
            raise ValueError(
                f"views must satisfy 2 <= min_views <= max_views <= data.num_views, got "
                f"{self.min_views}, {self.max_views}, {most}"
            )
        check_seed(self)
        check_at_least(0, self, "weight_decay", "warmup", "pose_noise")
        check_at_least(1, self, "steps", "batch_size", "accumulate", "devices", "num_nodes")
        check_at_least(8, self, "num_keypoints")
        check_positive(self, "learning_rate", "encoder_rate", "clip_gradient")
        check_share(self, "average")
        if set(self.freeze) >= set(get_args(Stage)):
            raise ValueError("freeze must leave a stage that learns, got all of them")
        if self.batch_size % self.accumulate:
            raise ValueError(
                f"batch_size must be a multiple of accumulate, got {self.batch_size} and "
                f"{self.accumulate}"
            )
        if self.batch_size % self.data.replay:
            raise ValueError(
                f"batch_size must be a multiple of data.replay, got {self.batch_size} and "
                f"{self.data.replay}"
            )
        if not self.sizes or min(map(min, self.sizes)) < 32:
            raise ValueError(f"sizes must be HEIGHT WIDTH of 32 or more, got {self.sizes}")
