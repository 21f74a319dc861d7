"""Score maps of the reference network, the matches and the weights it reads from them."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from deltas_nets.reference.segments import OFFSET, ReferenceSegments, place_on_segments

_WEIGHT_FLOOR = 0.001


class MatchNorm(nn.Module):
    """The one-channel batch norm after the correlation, by its name in the checkpoint."""

    def __init__(self) -> None:
        super().__init__()
        self.bn_match_convD = nn.BatchNorm2d(1)

    def forward(self, correlation: Tensor) -> Tensor:
        """Scores of the same shape, not negative."""
        normed: Tensor = self.bn_match_convD(correlation.reshape(-1, 1, 1, 1))
        return F.relu(normed).view_as(correlation)


class ReferenceMatches(NamedTuple):
    """Where the key points are seen in the sources.

    Attributes:
        pixels: ``(B, V, N, 2)``; (0, 0) for segments without length.
        weights: ``(B, V, N)`` factors of the triangulation's rows, never 0.
    """

    pixels: Tensor
    weights: Tensor


def correlate_samples(descriptors: Tensor, keypoints: Tensor, samples: Tensor) -> Tensor:
    """Correlation ``(B, V, N, 3, S)`` of the key points with the samples.

    Args:
        descriptors: ``(B, 1 + V, D, h, w)`` of unit length, the anchor first.
        keypoints: ``(B, N, 2)`` pixels of the anchor.
        samples: ``(B, V, N, 3, S, 2)`` pixels of the sources.
    """
    template = sample_descriptors(descriptors[:, 0], keypoints[:, :, None]).squeeze(-1)  # (B, D, N)
    maps = []
    # View by view: the descriptors of all samples at once would take V times the memory.
    for source, positions in zip(descriptors[:, 1:].unbind(1), samples.unbind(1), strict=True):
        read = sample_descriptors(source, positions.flatten(2, 3))
        products = torch.einsum("bdn,bdns->bns", template, read)
        maps.append(products.view(positions.shape[:-1]))
    return torch.stack(maps, dim=1)


def sample_descriptors(feature: Tensor, pixels: Tensor) -> Tensor:
    """Unit descriptors ``(B, D, N, S)``; zero where the lookup sees nothing but padding.

    The coordinates are those of corner-aligned lookup, but the lookup is not: it reads up to half
    a cell too far to the left and to the top, less and less towards the other borders.

    Args:
        feature: ``(B, D, h, w)``, a cell for every 8 pixels.
        pixels: ``(B, N, S, 2)``.
    """
    height, width = feature.shape[-2:]
    stride = 8
    size = pixels.new_tensor([width, height])
    grid = 2 * (pixels - stride / 2 + 0.5) / (size * stride - stride / 2 - 0.5) - 1
    read = F.grid_sample(feature, grid, mode="bilinear", padding_mode="zeros", align_corners=False)
    return F.normalize(read, dim=1)


def read_matches(
    scores: Tensor, segments: ReferenceSegments, *, offset: float = OFFSET
) -> ReferenceMatches:
    """Centre of mass of every score map, and its maximum as a weight.

    Args:
        scores: ``(B, V, N, 3, S)``, not negative.
        segments: where they were sampled.
        offset: of the lines beside the epipolar line, pixels.
    """
    num_lines, num_samples = scores.shape[-2:]
    probability = scores.flatten(-2).softmax(dim=-1).view_as(scores)
    columns = torch.arange(num_samples, device=scores.device, dtype=scores.dtype)
    rows = torch.arange(num_lines, device=scores.device, dtype=scores.dtype)
    column = (probability.sum(dim=-2) * columns).sum(dim=-1)
    row = (probability.sum(dim=-1) * rows).sum(dim=-1)
    along = segments.length * (column / (num_samples - 1) - 0.5)
    # The samples lie up to the offset across the line, the match only up to half of it.
    across = offset * (row / (num_lines - 1) - 0.5)
    pixels = place_on_segments(segments.angle, segments.center, along, across)
    has_length = segments.length > 0
    certainty = scores.flatten(-2).amax(dim=-1).sigmoid()
    return ReferenceMatches(
        torch.where(has_length[..., None], pixels, 0.0),
        certainty * (segments.in_range.to(scores.dtype) + _WEIGHT_FLOOR),
    )
