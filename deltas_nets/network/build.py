"""From a config to the stages of a network."""

from typing import NamedTuple

from deltas_nets.config import MatcherConfig, NetworkConfig
from deltas_nets.network.joint.judge import Judge
from deltas_nets.network.joint.matcher import JointMatcher
from deltas_nets.network.lite.densifier import Densifier
from deltas_nets.network.lite.descriptor import Descriptor
from deltas_nets.network.lite.detector import Detector
from deltas_nets.network.lite.encoder import Encoder
from deltas_nets.network.paper.paper import (
    PaperDensifier,
    PaperDescriptor,
    PaperDetector,
    PaperEncoder,
)
from deltas_nets.network.paper.per_view_matcher import PerViewMatcher
from deltas_nets.network.paper.resnet import ResNet50
from deltas_nets.network.paper.taps import Backbone
from deltas_nets.network.paper.vgg import VGG9

Matcher = JointMatcher | PerViewMatcher


class Stages(NamedTuple):
    """What :class:`deltas_nets.network.deltas.Deltas` composes, in order.

    Only the joint matcher has a judge.
    """

    encoder: Encoder | PaperEncoder
    detector: Detector | PaperDetector
    descriptor: Descriptor | PaperDescriptor
    matcher: Matcher
    judge: Judge | None
    densifier: Densifier | PaperDensifier


def build_stages(config: NetworkConfig) -> Stages:
    """The stages that a config names."""
    matcher = build_matcher(config.matcher, config.descriptor_dim)
    if config.backbone == "lite":
        return Stages(
            Encoder(),
            Detector(config.detector),
            Descriptor(config.descriptor_dim, config.descriptor_stride),
            matcher,
            Judge(config.matcher.window) if config.matcher.kind == "joint" else None,
            Densifier(_four(config.densifier_widths)),
        )
    backbones: dict[str, type[Backbone]] = {"resnet50": ResNet50, "vgg9": VGG9}
    backbone = backbones[config.backbone]
    image, sparse = backbone(3, 64), backbone(1, 16)
    return Stages(
        PaperEncoder(image),
        PaperDetector(config.detector, image.channels, config.head_width),
        PaperDescriptor(image.channels, config.descriptor_dim, config.head_width),
        matcher,
        None,  # a point's confidence is its matches' weight
        PaperDensifier(sparse, image.channels, _five(config.densifier_widths)),
    )


def build_matcher(config: MatcherConfig, descriptor_dim: int) -> Matcher:
    """The matcher a config names."""
    kinds: dict[str, type[JointMatcher] | type[PerViewMatcher]] = {
        "joint": JointMatcher,
        "per_view": PerViewMatcher,
    }
    return kinds[config.kind](config, descriptor_dim)


def _four(widths: tuple[int, ...]) -> tuple[int, int, int, int]:
    half, quarter, eighth, sixteenth = widths
    return half, quarter, eighth, sixteenth


def _five(widths: tuple[int, ...]) -> tuple[int, int, int, int, int]:
    sixteenth, eighth, quarter, half, full = widths
    return sixteenth, eighth, quarter, half, full
