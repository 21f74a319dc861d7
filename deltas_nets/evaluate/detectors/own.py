"""Detector and descriptor of our networks, and of the one that the paper's authors published."""

from pathlib import Path

from torch import Tensor

from deltas_nets import reference
from deltas_nets.evaluate.detectors.dense import DenseExtractor, Look, of_map
from deltas_nets.network.image_range import check_images
from deltas_nets.network.lite.detector import detector_heatmap
from deltas_nets.reference.features import evaluation_input
from deltas_nets.weights_file import load_model, weights_file

__all__ = ["THRESHOLD", "ours"]

THRESHOLD = 5e-4
"""The paper's, in training and in table 1."""


def ours(name_or_file: str | Path) -> DenseExtractor:
    """A network of deltas by name or file, or the published checkpoint: the file tells which.

    The descriptors are matched over the whole image here, though training compares them along
    epipolar lines alone.

    Raises:
        UserError: no such weights, or the file holds something else.
    """
    file = weights_file(name_or_file)
    return _published(file) if reference.is_published(file) else _of_deltas(file)


def _of_deltas(file: Path) -> DenseExtractor:
    model = load_model(file)

    def look(images: Tensor) -> Look:
        check_images(images)
        size = (images.shape[-2], images.shape[-1])
        features = model.encoder(images[:, None])
        scores = detector_heatmap(model.detector(features, image_size=size).logits, image_size=size)
        return Look(scores, of_map(model.descriptor(features).maps[:, 0], size))

    return DenseExtractor(look, THRESHOLD)


def _published(file: Path) -> DenseExtractor:
    network = reference.load(file)

    def look(images: Tensor) -> Look:
        size = (images.shape[-2], images.shape[-1])
        features = network.features(evaluation_input(images))
        scores = detector_heatmap(features.detector.logits, image_size=size)
        return Look(scores, of_map(features.descriptor.unit, size))

    return DenseExtractor(look, THRESHOLD)
