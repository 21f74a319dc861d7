"""Points of an image and what each is recognised by: what every detector gives."""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from deltas_nets.config.checks import check_at_least
from deltas_nets.evaluate.repeatability import strongest_points

__all__ = ["DetectionConfig", "Extractor", "Features", "strongest_features_of_map", "thinned"]


@dataclass(frozen=True)
class DetectionConfig:
    """Which points count, of every detector alike."""

    nms_radius: int = 3
    """None is so near to a stronger one, pixels along an axis (the paper: 3)."""
    num_points: int | None = None
    """The strongest so many of every image, whatever the detector's threshold; if not given, those
    above its own threshold (the paper)."""
    border: int = 4
    """None is nearer to the border, pixels."""

    def __post_init__(self) -> None:
        check_at_least(0, self, "nms_radius", "border")
        if self.num_points is not None:
            check_at_least(1, self, "num_points")


class Features(NamedTuple):
    """Points of one image.

    Attributes:
        pixels: ``(N, 2)``, strongest first.
        descriptors: ``(N, D)``, compared by their Euclidean distance; of binary ones its square
            counts the bits that differ. D is 0 where points have none.
    """

    pixels: Tensor
    descriptors: Tensor


class Extractor(Protocol):
    """A detector with its descriptor."""

    def __call__(self, image: Tensor, config: DetectionConfig, /) -> Features:
        """Features of an image ``(3, H, W)``, RGB in [0, 1]."""
        ...


def strongest_features_of_map(
    scores: Tensor, config: DetectionConfig, *, threshold: float
) -> Tensor:
    """The points ``(N, 2)`` that count of a score map ``(1, 1, H, W)``, strongest first.

    Args:
        scores: how much of an interest point every pixel is.
        config: how many and how far apart.
        threshold: of the detector; points of less are left out unless a number is asked for.
    """
    count = config.num_points or scores.numel()
    found = strongest_points(scores, count, nms_radius=config.nms_radius, border=config.border)
    if config.num_points is not None:
        return found
    column, row = found.long().unbind(dim=-1)
    return found[scores[0, 0, row, column] > threshold]


def thinned(
    pixels: Tensor, strength: Tensor, image_size: tuple[int, int], config: DetectionConfig
) -> Tensor:
    """Indices ``(n,)`` of the points of a list that count, strongest first.

    Args:
        pixels: ``(N, 2)``.
        strength: ``(N,)``.
        image_size: (height, width).
        config: how many and how far apart.

    Example:
        >>> pixels = torch.tensor([[10.0, 10], [12, 10], [20, 10]])
        >>> thinned(pixels, torch.tensor([1.0, 2, 3]), (40, 40), DetectionConfig()).tolist()
        [2, 1]
    """
    height, width = image_size
    low, high = config.border, torch.tensor([width, height]) - 1 - config.border
    inside = ((pixels >= low) & (pixels <= high)).all(dim=-1)
    order = strength.argsort(descending=True, stable=True)
    kept: list[int] = []
    for index in order[inside[order]].tolist():
        near = (pixels[kept] - pixels[index]).abs().amax(dim=-1) <= config.nms_radius
        if not bool(near.any()):
            kept.append(index)
        if len(kept) == config.num_points:
            break
    return torch.tensor(kept, dtype=torch.long)
