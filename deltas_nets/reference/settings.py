"""The numbers that the authors' program ran with."""

from deltas_nets.config.varied import NetworkSettings
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
