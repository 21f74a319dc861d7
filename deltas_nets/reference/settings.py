"""The numbers that the authors' program ran with, and the key points that others choose."""

import torch
from torch import Tensor

from deltas_nets.config.varied import NetworkSettings
from deltas_nets.reference.keypoints import fill_keypoints, pick_keypoints
from deltas_nets.reference.segments import NUM_SAMPLES, OFFSET

PUBLISHED = NetworkSettings(
    num_points=512,
    detected_share=0.5,
    nms_radius=9,
    threshold=0.0005,
    num_samples=NUM_SAMPLES,
    offset=OFFSET,
)
"""Of the published weights."""


def choose_keypoints(
    heatmap: Tensor, settings: NetworkSettings, *, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """Key points ``(N, 2)`` of one image and their scores ``(N,)``: detected and random ones.

    Args:
        heatmap: ``(H, W)`` probability of a key point.
        settings: what is not given is as in :data:`PUBLISHED`.
        generator: of the random ones; on the CPU, whatever the device of the points.
    """
    given = PUBLISHED.given() | settings.given()
    detected = pick_keypoints(
        heatmap,
        num_points=given["num_points"],
        radius=given["nms_radius"],
        threshold=given["threshold"],
        fraction=given["detected_share"],
    )
    return fill_keypoints(detected, num_points=given["num_points"], generator=generator)
