"""What goes into the image network, and what is shown of what comes out."""

import torch
from torch import Tensor

from deltas_nets.network.lite.detector import CELL, detector_heatmap
from deltas_nets.network.paper.taps import Taps
from deltas_nets.reference.outputs import FeatureOutputs, ReferenceFeatures


def evaluation_input(images: Tensor) -> Tensor:
    """RGB in [0, 1] as the original evaluation fed it: in [-1, 1].

    The network normalises by ImageNet's mean and deviation on top of this. Weights that were
    trained so want their images so.
    """
    return (images - 0.5) / 0.5


def shown_features(features: ReferenceFeatures) -> FeatureOutputs:
    """What a run shows of the features of an anchor and its sources."""
    taps, detector, descriptor = features
    means = Taps(*(tap.mean(dim=1) for tap in taps))
    return FeatureOutputs(
        *means,
        detector.upsampled.mean(dim=1),
        detector.logits,
        descriptor.joined_eighth.mean(dim=1),
        descriptor.joined_fine.mean(dim=1),
        torch.linalg.vector_norm(descriptor.raw, dim=1),
        descriptor.unit,
        heatmap_of(detector.logits[0]),
    )


def heatmap_of(logits: Tensor) -> Tensor:
    """Probability of a key point at every pixel, ``(H, W)``.

    Args:
        logits: ``(65, H/8, W/8)`` of one image.
    """
    size = (CELL * logits.shape[-2], CELL * logits.shape[-1])
    return detector_heatmap(logits[None], image_size=size)[0, 0]
