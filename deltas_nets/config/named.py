"""Networks and their trainings by name: `deltas-small`, and the paper's beside it."""

import dataclasses

from deltas_nets.config.losses import PAPER_LOSS, LossConfig
from deltas_nets.config.network import DetectorConfig, MatcherConfig, NetworkConfig
from deltas_nets.config.training import DataConfig, TrainConfig

_PAPER_DETECTOR = DetectorConfig(num_keypoints=512, nms_radius=9, border=4, fine_width=0)
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
    "cost-volume": NetworkConfig(
        name="cost-volume",
        matcher=MatcherConfig(kind="volume"),
        densifier_widths=(64, 96, 128, 160),
    ),
}
"""Networks by name; the second is the paper's, the third the light one of its supplement, the last
one of another kind to measure beside them."""


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
    "cost-volume": TrainConfig(
        network=CONFIGS["cost-volume"],
        # It has no points, and learns from the dense map alone.
        loss=LossConfig(detector=0, match=0, point=0, posterior=0, confidence=0),
    ),
}
"""Training by network. The paper's have its five losses, and a little of the likelihood that
teaches the dense map's spread."""
