"""What a network is made of; the defaults are `deltas-small`."""

from dataclasses import dataclass, field
from typing import Literal

from deltas_nets.config.checks import check_at_least, check_finite, check_positive, check_share
from deltas_nets.config.encoders import ENCODERS, Backbone


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
    fine_width: int = 16
    """lite: channels of the branch at half the image's resolution, which says where in its cell a
    point is; 0 is none."""

    def __post_init__(self) -> None:
        check_at_least(0, self, "nms_radius", "border", "fine_width")
        check_at_least(8, self, "num_keypoints")
        check_share(self, "threshold")
        if not 0 <= self.detected_share <= 1:
            raise ValueError(f"detected_share must be within [0, 1], got {self.detected_share}")


@dataclass(frozen=True)
class MatcherConfig:
    """How keypoints find their depth in the sources."""

    kind: Literal["joint", "per_view", "volume"] = "joint"
    """joint fuses all views at common inverse depths; per_view decides in each, as the paper.
    volume has no keypoints: it compares every pixel at every depth, as MVDepthNet."""
    num_samples: int = 64
    """per_view: samples along a segment (the paper: 100); joint: bins of inverse depth; volume:
    planes."""
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
        check_at_least(0, self, "context_rounds", "window", "refine_radius")
        check_at_least(1, self, "max_refinement", "context_heads")
        check_at_least(8, self, "num_samples")
        check_positive(self, "step")
        check_finite(self, "offsets")
        if not self.offsets:
            raise ValueError("offsets must name a line, for example 0")


@dataclass(frozen=True)
class NetworkConfig:
    """A network; the defaults are `deltas-small`."""

    name: str = "deltas-small"
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    matcher: MatcherConfig = field(default_factory=MatcherConfig)
    backbone: Backbone = "lite"
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
    redraws: bool = False
    """lite: a second densifier, of the same widths, draws maps anew that several frames agreed on;
    `deltas redraw` trains it when all else is trained."""

    def __post_init__(self) -> None:
        if self.backbone not in ENCODERS:
            raise ValueError(f"backbone must be one of {', '.join(ENCODERS)}, got {self.backbone}")
        lite = ENCODERS[self.backbone].stages == "lite"
        wanted = 4 if lite else 5
        if len(self.densifier_widths) != wanted:
            raise ValueError(
                f"densifier_widths must be {wanted} numbers for {self.backbone}, got "
                f"{self.densifier_widths}"
            )
        check_at_least(1, self, "descriptor_dim", "head_width", "densifier_widths")
        if not lite and self.matcher.kind != "per_view":
            kind = self.matcher.kind
            raise ValueError(f"the {kind} matcher needs the lite backbone, got {self.backbone}")
        if not lite and self.descriptor_stride != 2:
            raise ValueError(f"descriptor_stride is of the lite backbone, got {self.backbone}")
        if self.redraws and (not lite or self.matcher.kind == "volume"):
            raise ValueError("redraws is of networks of points with the lite backbone")
