"""Networks that say of every pixel how much of a point it is, and what it looks like."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from deltas_geom.epipolar.sampling import sample_map
from deltas_nets.distill.kornia_detectors import (
    DiskScores,
    XfeatScores,
    load_disk,
    load_xfeat,
    pad_to_multiple,
)
from deltas_nets.distill.superpoint import load_superpoint
from deltas_nets.evaluate.detectors.features import (
    DetectionConfig,
    Features,
    strongest_features_of_map,
)

__all__ = ["DenseExtractor", "Look", "disk", "superpoint", "xfeat"]


class Look(NamedTuple):
    """What a network makes of one image.

    Attributes:
        scores: ``(1, 1, H, W)``.
        describe: pixels ``(N, 2)`` to descriptors ``(N, D)`` of unit length.
    """

    scores: Tensor
    describe: Callable[[Tensor], Tensor]


class DenseExtractor:
    """Points are local maxima of a score map; descriptors are read where they are.

    Args:
        look: an image ``(1, 3, H, W)`` to the maps.
        threshold: weakest score that the network's authors take for a point.
    """

    def __init__(self, look: Callable[[Tensor], Look], threshold: float) -> None:
        self.look = look
        self.threshold = threshold

    @torch.inference_mode()
    def __call__(self, image: Tensor, config: DetectionConfig) -> Features:
        """See :class:`~deltas_nets.evaluate.detectors.features.Extractor`."""
        seen = self.look(image[None])
        pixels = strongest_features_of_map(seen.scores, config, threshold=self.threshold)
        return Features(pixels.clone(), seen.describe(pixels).float().clone())


def of_map(descriptors: Tensor, image_size: tuple[int, int]) -> Callable[[Tensor], Tensor]:
    """Reads a map ``(1, D, h, w)`` that spans the image plane, bilinearly, to unit length."""

    def describe(pixels: Tensor) -> Tensor:
        return F.normalize(sample_map(descriptors[0], pixels, image_size=image_size), dim=-1)

    return describe


def superpoint(file: Path) -> DenseExtractor:
    """SuperPoint of a file; threshold and bilinear descriptors as its authors' demo."""
    network = load_superpoint(file)

    def look(images: Tensor) -> Look:
        seen = network.maps(images)
        # Cells span a padded image where the sides are no multiples of them.
        size = (8 * seen.descriptors.shape[-2], 8 * seen.descriptors.shape[-1])
        return Look(seen.scores, of_map(seen.descriptors, size))

    return DenseExtractor(look, threshold=0.015)


def disk(file: Path) -> DenseExtractor:
    """DISK of a file; a point is accepted where its logit is above 0."""
    network = load_disk(file).network

    def look(images: Tensor) -> Look:
        height, width = images.shape[-2:]
        padded = pad_to_multiple(images, DiskScores.MULTIPLE)
        heatmap, descriptors = network.heatmap_and_dense_descriptors(padded)  # type: ignore[operator]
        scores = heatmap[..., :height, :width].sigmoid()
        return Look(scores, of_map(descriptors[..., :height, :width], (height, width)))

    return DenseExtractor(look, threshold=0.5)


def xfeat(file: Path) -> DenseExtractor:
    """XFeat of a file."""
    scorer = load_xfeat(file)

    def look(images: Tensor) -> Look:
        descriptors = scorer.network(pad_to_multiple(images, XfeatScores.MULTIPLE))[0]
        size = (8 * descriptors.shape[-2], 8 * descriptors.shape[-1])
        return Look(scorer(images), of_map(F.normalize(descriptors, dim=1), size))

    return DenseExtractor(look, threshold=0.05)
