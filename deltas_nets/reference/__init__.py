"""The network that the paper's authors published, run exactly as it was, with its quirks.

The layers are those of `deltas_nets.network`; what this package adds is how their
program chose segments, read descriptors, weighted views and drew the sparse depth. What differs
from the paper and from the rest of deltas is listed in `docs/differences.md`.

Example:
    >>> from deltas_nets import reference
    >>> reference.is_published("weights.safetensors")
    False
"""

from deltas_nets.reference.checkpoint import is_published, load
from deltas_nets.reference.features import evaluation_input
from deltas_nets.reference.keypoints import DetectedKeypoints, fill_keypoints, pick_keypoints
from deltas_nets.reference.metrics import metric_result
from deltas_nets.reference.network import ReferenceNetwork
from deltas_nets.reference.outputs import (
    DensifyOutputs,
    MatchOutputs,
    ReferenceFeatures,
    ReferenceOutputs,
    ReferencePrediction,
)

__all__ = [
    "DensifyOutputs",
    "DetectedKeypoints",
    "MatchOutputs",
    "ReferenceFeatures",
    "ReferenceNetwork",
    "ReferenceOutputs",
    "ReferencePrediction",
    "evaluation_input",
    "fill_keypoints",
    "is_published",
    "load",
    "metric_result",
    "pick_keypoints",
]
