"""The paper's matcher: descriptors read along each source's epipolar segment, and multiplied.

`deltas_geom.correlate` has the same values sooner, but multiplies every keypoint with whole
maps: four times the products where maps are as coarse as the paper's. This network counts what
the paper's does.
"""

import torch
from torch import Tensor, nn

from deltas_geom import (
    PosedViews,
    Samples,
    correlate,
    epipolar_segments,
    match_per_view,
    sample_map,
    sample_segments,
)
from deltas_geom.numerics.arithmetic import promoted, without_autocast
from deltas_geom.numerics.evaluation import recomputed
from deltas_nets.config import MatcherConfig
from deltas_nets.network.joint.matcher import at_keypoints
from deltas_nets.network.layers import WideBatchNorm1d
from deltas_nets.network.lite.descriptor import Descriptors
from deltas_nets.network.records import Matched, Posterior


class PerViewMatcher(nn.Module):
    """The paper's: each source decides alone, weighted DLT reconciles them."""

    def __init__(self, config: MatcherConfig, descriptor_dim: int) -> None:
        super().__init__()
        self.config = config
        self.norm = WideBatchNorm1d(1)
        self.log_scale = nn.Parameter(torch.tensor(2.0))

    def forward(
        self,
        keypoints: Tensor,
        descriptors: Descriptors,
        views: PosedViews,
        *,
        image_size: tuple[int, int],
        depth_range: tuple[float, float],
        refinement: int | None = None,
    ) -> Matched:
        """Match ``(B, N, 2)`` keypoints of the anchor in each source alone.

        There is no ``refinement``: each source is searched where it can see the point.
        """
        segments = epipolar_segments(
            views, keypoints, depth_range=depth_range, image_size=image_size
        )
        samples = sample_segments(
            segments, self.config.num_samples, offsets=self.config.offsets, image_size=image_size
        )
        anchor = at_keypoints(descriptors, keypoints, image_size)
        correlation = read_and_multiply(
            anchor, descriptors.maps[:, 1:], samples, image_size=image_size
        )
        normed = self.norm(correlation.reshape(-1, 1)).view_as(correlation).relu()
        scores = normed * self.log_scale.exp()
        matches = match_per_view(keypoints, scores, samples)
        along = torch.where(samples.mask, scores, torch.finfo(scores.dtype).min / 4)
        posterior = Posterior(
            (along.logsumexp(dim=-2),), samples.inv_depth, samples.mask.any(dim=-2)
        )
        confidence = torch.where(matches.mask, matches.weights, 0.0)[:, 1:].amax(dim=1)
        return Matched(matches, confidence, posterior, None)


@without_autocast
def read_and_multiply(
    descriptors: Tensor, feature_map: Tensor, samples: Samples, *, image_size: tuple[int, int]
) -> Tensor:
    """Dot products of keypoint descriptors with descriptors read at samples.

    The values of :func:`deltas_geom.correlate`, in the paper's order and with its number of
    products: D for each sample. Keeps nothing but its arguments for the backward pass, and is in
    float32 at least, whatever ``torch.autocast`` says.

    Args:
        descriptors: ``(B, N, D)`` of the anchor's keypoints.
        feature_map: ``(B, V-1, D, h, w)`` of the sources.
        samples: places in the sources, ``(B, V-1, N, O, S, 2)``.
        image_size: (height, width) of the sources' images.

    Returns:
        ``(B, V-1, N, O, S)``; 0 with zero gradient where the sample is masked.

    Source: the paper, section 3.2.
    """

    def correlated(
        descriptors: Tensor, feature_map: Tensor, pixels: Tensor, mask: Tensor
    ) -> tuple[Tensor]:
        places = samples._replace(pixels=pixels, mask=mask)
        return (correlate(descriptors, feature_map, places, image_size=image_size),)

    def read(
        descriptors: Tensor, feature_map: Tensor, pixels: Tensor, mask: Tensor
    ) -> tuple[Tensor]:
        # View by view: the descriptors of all samples at once would take V-1 times the memory.
        sources = zip(feature_map.unbind(1), pixels.unbind(1), mask.unbind(1), strict=True)
        products = [_dot_products(descriptors, *each, image_size=image_size) for each in sources]
        return (torch.stack(products, dim=1),)

    # Both orders have the same derivatives. Through D channels at every sample they would take
    # more than ten times as long as through the one of the correlation.
    tensors = (descriptors, feature_map, samples.pixels, samples.mask)
    return recomputed(correlated, *tensors, values=read)[0]


def _dot_products(
    descriptors: Tensor,
    features: Tensor,
    pixels: Tensor,
    mask: Tensor,
    *,
    image_size: tuple[int, int],
) -> Tensor:
    """Multiply descriptors ``(B, N, D)`` with features ``(B, D, h, w)`` at ``(B, N, O, S, 2)``."""
    read = sample_map(features, pixels.flatten(1, 3), image_size=image_size)
    descriptors, read = promoted(descriptors, read.reshape(*mask.shape, read.shape[-1]))
    return torch.where(mask, torch.einsum("bnd,bnosd->bnos", descriptors, read), 0.0)
