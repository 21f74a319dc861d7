"""This builds the stages of a network from its config."""

from typing import NamedTuple

from deltas_nets.config import MatcherConfig, NetworkConfig
from deltas_nets.config.encoders import ENCODERS
from deltas_nets.config.lookup import look_up
from deltas_nets.network.joint.judge import Judge
from deltas_nets.network.joint.matcher import JointMatcher
from deltas_nets.network.lite.densifier import Densifier
from deltas_nets.network.lite.descriptor import Descriptor
from deltas_nets.network.lite.detector import Detector
from deltas_nets.network.lite.encoder import LiteEncoder
from deltas_nets.network.lite.redraw import Redraw
from deltas_nets.network.paper.paper import (
    PaperDensifier,
    PaperDescriptor,
    PaperDetector,
    PaperEncoder,
)
from deltas_nets.network.paper.per_view_matcher import PerViewMatcher
from deltas_nets.network.paper.taps import Backbone

Matcher = JointMatcher | PerViewMatcher


class Stages(NamedTuple):
    """What :class:`deltas_nets.network.deltas.Deltas` composes, in order.

    Only the joint matcher has a judge; only networks whose config says so redraw.
    """

    encoder: LiteEncoder | PaperEncoder
    detector: Detector | PaperDetector
    descriptor: Descriptor | PaperDescriptor
    matcher: Matcher
    judge: Judge | None
    densifier: Densifier | PaperDensifier
    redraw: Redraw | None


def build_stages(config: NetworkConfig) -> Stages:
    """The stages that a config names."""
    row = ENCODERS[config.backbone]
    encoder = look_up("deltas_nets.network", row.place)
    matcher = build_matcher(config.matcher, config.descriptor_dim)
    if row.stages == "lite":
        return _lite_stages(config, encoder.whole(), matcher)
    return _paper_stages(config, encoder(3, 64), encoder(1, 16), matcher)


def _lite_stages(config: NetworkConfig, encoder: LiteEncoder, matcher: Matcher) -> Stages:
    channels = encoder.channels
    return Stages(
        encoder,
        Detector(config.detector, channels),
        Descriptor(config.descriptor_dim, channels, config.descriptor_stride),
        matcher,
        Judge(config.matcher.window) if config.matcher.kind == "joint" else None,
        Densifier(_four(config.densifier_widths), channels),
        Redraw(_four(config.densifier_widths), channels) if config.redraws else None,
    )


def _paper_stages(
    config: NetworkConfig, image: Backbone, sparse: Backbone, matcher: Matcher
) -> Stages:
    return Stages(
        PaperEncoder(image),
        PaperDetector(config.detector, image.channels, config.head_width),
        PaperDescriptor(image.channels, config.descriptor_dim, config.head_width),
        matcher,
        None,  # a point's confidence is its matches' weight
        PaperDensifier(sparse, image.channels, _five(config.densifier_widths)),
        None,
    )


def build_matcher(config: MatcherConfig, descriptor_dim: int) -> Matcher:
    """The matcher a config names.

    Raises:
        ValueError: the config is of a network without points.
    """
    kinds: dict[str, type[JointMatcher] | type[PerViewMatcher]] = {
        "joint": JointMatcher,
        "per_view": PerViewMatcher,
    }
    if config.kind not in kinds:
        raise ValueError(f"a network of points has no {config.kind} matcher; see build_network")
    return kinds[config.kind](config, descriptor_dim)


def _four(widths: tuple[int, ...]) -> tuple[int, int, int, int]:
    half, quarter, eighth, sixteenth = widths
    return half, quarter, eighth, sixteenth


def _five(widths: tuple[int, ...]) -> tuple[int, int, int, int, int]:
    sixteenth, eighth, quarter, half, full = widths
    return sixteenth, eighth, quarter, half, full
