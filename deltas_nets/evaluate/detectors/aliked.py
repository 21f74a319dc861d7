"""ALIKED of kornia, with its points between pixels and its deformable descriptors."""

from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from kornia.feature import ALIKED
from torch import Tensor, nn

from deltas_nets.distill.kornia_detectors import load_aliked
from deltas_nets.evaluate.detectors.features import DetectionConfig, Features

__all__ = ["aliked"]

THRESHOLD = 0.2
"""Its authors'."""


class AlikedExtractor:
    """ALIKED under any radius of suppression.

    Args:
        network: of kornia, with weights.
    """

    def __init__(self, network: nn.Module) -> None:
        self.network: Any = network
        self._as = lru_cache(maxsize=1)(self._built)

    @torch.inference_mode()
    def __call__(self, image: Tensor, config: DetectionConfig) -> Features:
        """See :class:`~deltas_nets.evaluate.detectors.features.Extractor`."""
        found = self._as(config)(image[None])[0]
        last = torch.tensor([image.shape[-1], image.shape[-2]]).to(image) - 1
        pixels = found.keypoints
        inside = ((pixels >= config.border) & (pixels <= last - config.border)).all(dim=-1)
        order = found.keypoint_scores.argsort(descending=True)
        order = order[inside[order]]
        return Features(pixels[order].float().clone(), found.descriptors[order].float().clone())

    def _built(self, config: DetectionConfig) -> nn.Module:
        network: nn.Module = ALIKED(
            model_name=self.network.model_name,
            max_num_keypoints=config.num_points or -1,
            detection_threshold=0.0 if config.num_points else THRESHOLD,
            nms_radius=config.nms_radius,
        )
        weights = {k: v for k, v in self.network.state_dict().items() if k != "dkd.hw_grid"}
        network.load_state_dict(weights, strict=False)
        return network.eval()


def aliked(file: Path) -> AlikedExtractor:
    """ALIKED of a file.

    Raises:
        UserError: the file cannot be read, or a weight is missing.
    """
    return AlikedExtractor(load_aliked(file).network)
