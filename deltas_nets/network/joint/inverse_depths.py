"""How finely inverse depth is searched: as finely as the widest view needs it.

What is believed about a point's depth is believed of bins, the same for all points. Where a bin
is longer in a source than a peak of correlation is wide, one sample a bin would miss the peak:
there a bin has several samples, and the best of them speaks for it.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom import PosedViews, sample_inv_depths
from deltas_geom.numerics.arithmetic import without_gradients


class Bins(NamedTuple):
    """The best sample of every bin.

    Attributes:
        score: ``(B, N, S)`` fused over the views.
        share: ``(B, N, S)`` of the sources that see the sample; 0 where none sees any of its bin.
        inv_depth: ``(B, N, S)`` of the sample, 1/m; the bin's centre where none is seen.
    """

    score: Tensor
    share: Tensor
    inv_depth: Tensor


def bin_centres(num_bins: int, depth_range: tuple[float, float], *, like: Tensor) -> Tensor:
    """``(S,)`` evenly spaced inverse depths from far to near, 1/m."""
    near, far = depth_range
    return torch.linspace(1 / far, 1 / near, num_bins, device=like.device, dtype=like.dtype)


@without_gradients
def samples_per_bin(
    views: PosedViews,
    keypoints: Tensor,
    centres: Tensor,
    *,
    step: float,
    most: int,
    image_size: tuple[int, int],
) -> Tensor:
    """How many samples a bin needs, ``(B,)`` whole numbers from 1 to ``most``.

    Each view set of a batch has its own number, which does not depend on the others.

    Args:
        views: the anchor (view 0) and its sources, ``(B, V)``.
        keypoints: ``(B, N, 2)`` of the anchor.
        centres: ``(S,)`` of the bins.
        step: samples are at most this far apart in the widest view, pixels, unless that takes
            more than ``most``. It is measured between centres that are both in the image.
        most: samples per bin.
        image_size: (height, width) of the sources.
    """
    places = sample_inv_depths(views, keypoints, centres, image_size=image_size)
    apart = torch.linalg.vector_norm(places.pixels.diff(dim=-2), dim=-1)
    both = places.mask[..., 1:] & places.mask[..., :-1]
    widest = torch.where(both, apart, 0.0).flatten(1).amax(dim=1)
    return (widest / step).ceil().clamp(1, most).long()


def subdivide(centres: Tensor, counts: Tensor, most: int) -> Tensor:
    """Samples ``(B, S, most)`` that divide every bin evenly around its centre, 1/m.

    Args:
        centres: ``(S,)`` of the bins.
        counts: ``(B,)`` samples per bin.
        most: at least the largest count; the last sample is repeated up to it.
    """
    number = torch.arange(most, device=centres.device).minimum(counts[:, None] - 1)
    offset = (number + 0.5) / counts[:, None].to(centres.dtype) - 0.5
    samples = centres[:, None] + offset[:, None] * (centres[1] - centres[0])
    return samples.clamp_min(0)  # the farthest bin may reach beyond infinity


def best_of_bins(fused: Tensor, share: Tensor, samples: Tensor, centres: Tensor) -> Bins:
    """Reduce samples to bins.

    Args:
        fused: ``(B, N, S * k)`` scores of samples.
        share: ``(B, N, S * k)`` of the sources that see them; one that is seen goes before one
            that is not, whatever their scores.
        samples: ``(B, S, k)`` from :func:`subdivide`.
        centres: ``(S,)``.
    """
    by_bin = (*fused.shape[:-1], *samples.shape[-2:])
    fused, share = fused.reshape(by_bin), share.reshape(by_bin)
    lowest = torch.finfo(fused.dtype).min
    place = torch.where(share > 0, fused, lowest).argmax(dim=-1, keepdim=True)

    def at_best(values: Tensor) -> Tensor:
        return values.gather(-1, place).squeeze(-1)

    seen = at_best(share)
    inv_depth = at_best(samples.unsqueeze(1).expand_as(fused))
    return Bins(at_best(fused), seen, torch.where(seen > 0, inv_depth, centres))
