"""What a network, its losses and a training are made of: frozen dataclasses.

One dataclass is the flags of the command line, the argument in a notebook and the record that
is written beside the weights.
"""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_type_hints

import tyro

from deltas_nets.data.scannet_config import ScanNetConfig

Config = TypeVar("Config")


@dataclass(frozen=True)
class DetectorConfig:
    """Interest points: some detected, the others spread evenly over the image."""

    num_keypoints: int = 768
    """Points per image (the paper: 512 at 240 x 320)."""
    detected_share: float = 0.5
    """At most this share comes from the detector (the paper: 0.5)."""
    threshold: float = 5e-4
    """Weakest detection that is kept, as a probability (the paper: 5e-4)."""
    nms_radius: int = 4
    """Detections are at least this far apart, pixels (the paper: 9 at 240 x 320)."""
    border: int = 2
    """Nothing is detected nearer to the image border, pixels."""
    fine_width: int = 0
    """Channels of the branch at half the image's resolution, which says where in its cell a point
    is; 0 is none."""

    def __post_init__(self) -> None:
        if self.num_keypoints < 8:
            raise ValueError(f"num_keypoints must be at least 8, got {self.num_keypoints}")
        if not 0 <= self.detected_share <= 1:
            raise ValueError(f"detected_share must be within [0, 1], got {self.detected_share}")


@dataclass(frozen=True)
class MatcherConfig:
    """How keypoints find their depth in the sources."""

    kind: Literal["joint", "per_view"] = "joint"
    """joint fuses all views at common inverse depths; per_view decides in each, as the paper."""
    num_samples: int = 64
    """per_view: samples along a segment (the paper: 100); joint: bins of inverse depth."""
    offsets: tuple[float, ...] = (-1.0, 0.0, 1.0)
    """per_view: parallel lines searched besides the epipolar line, pixels."""
    step: float = 1.5
    """joint: depths are searched this far apart in the widest view, pixels, or closer: bins are
    subdivided until they are."""
    max_refinement: int = 8
    """joint: a bin is subdivided into at most this many samples."""
    context_rounds: int = 3
    """joint: rounds in which points exchange evidence before they decide; 0 is none."""
    context_heads: int = 4
    """joint: attention heads in each round."""
    window: int = 2
    """joint: soft-argmax looks this many bins to either side of the peak."""
    refine_radius: float = 3.0
    """joint: the 2D match may move this far along the epipolar line, pixels."""

    def __post_init__(self) -> None:
        if self.num_samples < 8:
            raise ValueError(f"num_samples must be at least 8, got {self.num_samples}")
        if not self.step > 0:
            raise ValueError(f"step must be positive, got {self.step}")
        if self.max_refinement < 1:
            raise ValueError(f"max_refinement must be at least 1, got {self.max_refinement}")


@dataclass(frozen=True)
class NetworkConfig:
    """A network; the defaults are `deltas-small`."""

    name: str = "deltas-small"
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    matcher: MatcherConfig = field(default_factory=MatcherConfig)
    backbone: Literal["lite", "resnet50", "vgg9"] = "lite"
    """Image encoder: lite is EfficientNet-Lite0; the others are the paper's and bring its heads and
    densifier."""
    descriptor_dim: int = 48
    """Channels of the descriptors (the paper: 128)."""
    descriptor_stride: Literal[2, 4] = 2
    """lite: descriptors at 1/2 or 1/4 of the image's resolution (the paper: 1/8)."""
    head_width: int = 256
    """Channels inside the paper's detector and descriptor heads; lite has its own."""
    densifier_widths: tuple[int, ...] = (32, 48, 64, 96)
    """Channels of the densifier: lite at 1/2, 1/4, 1/8, 1/16; else of the five blocks of the
    decoder, coarse to fine."""

    def __post_init__(self) -> None:
        wanted = 4 if self.backbone == "lite" else 5
        if len(self.densifier_widths) != wanted:
            raise ValueError(
                f"densifier_widths must be {wanted} numbers for {self.backbone}, got "
                f"{self.densifier_widths}"
            )
        if self.backbone != "lite" and self.matcher.kind == "joint":
            raise ValueError(f"the joint matcher needs the lite backbone, got {self.backbone}")
        if self.backbone != "lite" and self.descriptor_stride != 2:
            raise ValueError(f"descriptor_stride is of the lite backbone, got {self.backbone}")


@dataclass(frozen=True)
class LossConfig:
    """Weights of the loss terms; the first five are the paper's terms."""

    detector: float = 0.1
    """Cross-entropy of interest points."""
    match: float = 0.1
    """Smooth L1 of 2D matches, pixels."""
    point: float = 2.0
    """Smooth L1 of 3D points, relative to their depth."""
    smoothness: float = 0.02
    """Edge-aware smoothness of the dense map."""
    depth: float = 2.0
    """Smooth L1 of log depth at the finest of four scales."""
    scale_decay: float = 0.7
    """Factor of the depth term from a scale to the next coarser one (the paper: 0.7)."""
    gradient: float = 2.0
    """L1 of the gradient of log depth at the two finest scales: keeps edges where they are."""
    posterior: float = 1.0
    """Cross-entropy of the posterior over inverse depth, at every stage."""
    confidence: float = 0.5
    """Cross-entropy of the points' confidence."""
    spread: float = 0.2
    """Laplace likelihood of the dense map's own uncertainty."""


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
    """rooms: seed of the first one; validation rooms have seeds below 1000."""
    num_views: int = 5
    """rooms: views rendered of each; any of them can be the anchor."""
    height: int = 192
    """Height of the images that are rendered or read, pixels."""
    width: int = 256
    """Width of the images that are rendered or read, pixels."""
    cache: str | None = None
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
        if self.replay < 1 or self.shelf < 1:
            raise ValueError(
                f"replay and shelf must be at least 1, got {self.replay} and {self.shelf}"
            )


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
    freeze_batch_norm: bool = False
    """Batch norm keeps its mean and variance, as for fine-tuning with few rooms per step; its
    scale and shift still learn."""
    learning_rate: float = 2e-3
    """Peak of the schedule."""
    encoder_rate: float = 0.2
    """The encoder, which is pretrained, learns at this share of it."""
    schedule: Literal["cosine", "constant"] = "cosine"
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
    teacher: Literal["superpoint", "aliked", "disk", "xfeat"] | None = None
    """Whose interest points the detector learns to find (the paper: SuperPoint's), with weights
    from --teacher-weights; Shi-Tomasi corners without one."""
    pose_noise: tuple[float, float] = (0.004, 0.0015)
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
        for name in ("steps", "batch_size", "accumulate", "devices", "num_nodes"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
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


def to_dict(config: Any) -> dict[str, Any]:
    """A config dataclass as plain, JSON-ready values."""
    return dataclasses.asdict(config)


def from_dict(kind: type[Config], values: dict[str, Any]) -> Config:
    """The config that :func:`to_dict` recorded.

    Args:
        kind: the dataclass, for example :class:`NetworkConfig`.
        values: its fields; missing ones keep their defaults.

    Raises:
        ValueError: a field is unknown: the record is of another version.
    """
    hints = get_type_hints(kind)
    unknown = sorted(set(values) - set(hints))
    if unknown:
        raise ValueError(f"{kind.__name__} has no field {', '.join(unknown)}")
    read: dict[str, Any] = {}
    for name, value in values.items():
        hint = hints[name]
        if isinstance(hint, type) and dataclasses.is_dataclass(hint):
            value = from_dict(hint, value)
        else:
            value = _as_tuples(value)
        read[name] = value
    return kind(**read)


def without_paths(config: TrainConfig) -> TrainConfig:
    """The config as it may be shown to others: where files are is the machine's, and private.

    Of split and skip files the names stay.
    """
    scannet = config.data.scannet
    public = dataclasses.replace(
        scannet,
        root=None,
        split=Path(scannet.split).name,
        validation=None if scannet.validation is None else Path(scannet.validation).name,
        skip=None if scannet.skip is None else Path(scannet.skip).name,
    )
    data = dataclasses.replace(config.data, cache=None, scannet=public)
    return dataclasses.replace(config, data=data)


def _as_tuples(value: Any) -> Any:
    """JSON's lists as the tuples they were."""
    return tuple(_as_tuples(item) for item in value) if isinstance(value, list) else value


_PAPER_DETECTOR = DetectorConfig(num_keypoints=512, nms_radius=9, border=4)
_PAPER_MATCHER = MatcherConfig(kind="per_view", num_samples=100)

CONFIGS: dict[str, NetworkConfig] = {
    "deltas-small": NetworkConfig(),
    "deltas-resnet50": NetworkConfig(
        name="deltas-resnet50",
        detector=_PAPER_DETECTOR,
        matcher=_PAPER_MATCHER,
        backbone="resnet50",
        descriptor_dim=128,
        densifier_widths=(512, 256, 128, 64, 32),
    ),
    "deltas-vgg9": NetworkConfig(
        name="deltas-vgg9",
        detector=_PAPER_DETECTOR,
        matcher=_PAPER_MATCHER,
        backbone="vgg9",
        descriptor_dim=128,
        head_width=128,
        densifier_widths=(96, 64, 32, 16, 8),
    ),
}
"""Networks by name; the second is the paper's, the third the light one of its supplement."""

PAPER_LOSS = LossConfig(
    match=1.0, smoothness=1.0, gradient=0.0, posterior=0.0, confidence=0.0, spread=0.0
)
"""The five terms with the paper's weights, and no other."""


def _as_in_the_paper(name: str) -> TrainConfig:
    """Section 4.1: 100 000 steps of 24 triplets at 240 x 320, Adam at 1e-4 throughout."""
    return TrainConfig(
        network=CONFIGS[name],
        loss=dataclasses.replace(PAPER_LOSS, spread=0.1),
        data=DataConfig(height=240, width=320),
        steps=100_000,
        sizes=((240, 320),),
        batch_size=24,
        learning_rate=1e-4,
        encoder_rate=1.0,
        schedule="constant",
        weight_decay=0.0,
        min_views=3,
        max_views=3,
        num_keypoints=512,
        pose_noise=(0.0, 0.0),
    )


TRAIN_CONFIGS: dict[str, TrainConfig] = {
    "deltas-small": TrainConfig(),
    "deltas-resnet50": _as_in_the_paper("deltas-resnet50"),
    "deltas-vgg9": _as_in_the_paper("deltas-vgg9"),
}
"""Training by network. The paper's have its five losses, and a little of the likelihood that
teaches the dense map's spread."""
