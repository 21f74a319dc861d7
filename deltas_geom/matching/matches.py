"""Soft-argmax over samples, and matches of both kinds.

`match_per_view` decides in each source alone, as the paper does. `match_joint` averages the
evidence of all sources at common inverse depths before it decides, so that one wrong mode in
one view cannot pull the point away.
"""

import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import safe_divide
from deltas_geom.cameras.views import PosedViews
from deltas_geom.checks import (
    batch_shape,
    check_batch,
    check_bool,
    check_counts,
    check_positive,
    check_shapes,
)
from deltas_geom.epipolar.sampling import Samples, check_scores, sample_inv_depths
from deltas_geom.numerics.arithmetic import (
    both,
    finite_or_zero,
    only,
    unless_all,
    values_at_hand,
    without_autocast,
)
from deltas_geom.records import Record


class Matches(Record):
    """Where keypoints of the anchor are seen; ready for :func:`deltas_geom.triangulate`.

    Attributes:
        pixels: ``(*B, V, N, 2)``; entry 0 is the keypoint itself, sources follow in order.
        weights: ``(*B, V, N)`` not negative; the anchor's is 1. Of :func:`match_per_view` and
            :func:`match_joint` they are shares of probability, 0 to 1: right as the paper's
            weights of a DLT, where only their ratios count. They are not 1/px, which the
            covariance of :func:`deltas_geom.triangulate` and ``point_covariance`` read a weight
            as: for these take :func:`weights_from_covariance`.
        covariance: ``(*B, V, N, 2, 2)`` px^2; the anchor's is 0.
        mask: ``(*B, V, N)`` bool: the view has a match.
    """

    pixels: Tensor
    weights: Tensor
    covariance: Tensor
    mask: Tensor


class SoftArgmax(Record):
    """The mean place of a distribution over places, and how sure it is.

    Attributes:
        position: ``(*B, D)`` mean.
        covariance: ``(*B, D, D)``.
        peak: ``(*B)`` largest probability; 0 where every place is masked.
        mass: ``(*B)`` share of the probability inside the window (1 without a window).
        entropy: ``(*B)`` of the whole distribution, nats.
    """

    position: Tensor
    covariance: Tensor
    peak: Tensor
    mass: Tensor
    entropy: Tensor


@without_autocast
def soft_argmax(
    logits: Tensor, positions: Tensor, *, mask: Tensor | None = None, window: int | None = None
) -> SoftArgmax:
    """Mean position under the softmax of logits, optionally in a window around the peak.

    Args:
        logits: ``(*B, S)``. What is not finite, such as the -inf that often marks masked places,
            counts as masked.
        positions: ``(*B, S, D)`` or broadcastable, for example pixels or inverse depths. What is
            not finite counts as masked.
        mask: ``(*B, S)`` bool, True = possible; the others may hold anything.
        window: keep only places at most this many steps (0 or more) from the peak, so that a
            second mode elsewhere does not pull the mean between the two.

    Returns:
        Finite numbers always; where every place is masked all of them are 0.

    Raises:
        ShapeError: a trailing shape differs, or there is no place.
        TypeError: the mask is not bool.
        ValueError: the window is negative.

    Source: the paper, equations 2 and 3.

    Example:
        >>> logits = torch.tensor([0.0, 50.0, 0.0])
        >>> soft_argmax(logits, torch.tensor([[1.0], [2.0], [3.0]])).position
        tensor([2.])
    """
    batch = check_batch(logits=(logits, "+S"), positions=(positions, "S D"), mask=(mask, "S"))
    if window is not None:
        check_counts(0, window=window)
    # Beyond, squares of what is not possible count.
    positions, known = finite_or_zero(positions, limit=torch.finfo(positions.dtype).max ** 0.25)
    logits, finite = finite_or_zero(logits.expand(*batch, -1), dims=0)
    possible = both(both(mask, finite), None if known is None else known[..., 0])
    least = torch.finfo(logits.dtype).min
    probability = only(only(logits, possible, other=least).softmax(dim=-1), possible)
    peak, place = probability.max(dim=-1)
    entropy = -torch.special.xlogy(probability, probability.clamp_min(1e-30)).sum(dim=-1)
    near = probability
    if window is not None:
        index = torch.arange(logits.shape[-1], device=logits.device)
        near = torch.where((index - place[..., None]).abs() <= window, probability, 0.0)
    mass = near.sum(dim=-1)
    share = safe_divide(near, mass[..., None], (mass > 0)[..., None])
    position = (share[..., None] * positions).sum(dim=-2)
    offset = positions - position.unsqueeze(-2)
    covariance = (share[..., None] * offset).mT @ offset
    return SoftArgmax(position, covariance, peak, mass, entropy)


def matches_from_sources(
    keypoints: Tensor, pixels: Tensor, weights: Tensor, covariance: Tensor, mask: Tensor
) -> Matches:
    """Put the anchor's keypoints (weight 1, no covariance) before the sources' matches.

    A keypoint ``(*B, N, 2)`` that is not finite is no match. The others are as in a record of
    matches, but of V-1 views.
    """
    batch = batch_shape(keypoints.shape[:-2], weights.shape[:-2])
    keypoints, known = finite_or_zero(keypoints)
    known = None if known is None else known.mT  # beside the sources, as the mask is
    if batch != weights.shape[:-2]:
        sources = (pixels, -3), (weights, -2), (covariance, -4), (mask, -2)
        pixels, weights, covariance, mask = (x.expand(*batch, *x.shape[d:]) for x, d in sources)
    anchor = keypoints.expand(*batch, *keypoints.shape[-2:]).unsqueeze(-3)
    return Matches(
        torch.cat([anchor, pixels], dim=-3),
        torch.cat([torch.ones_like(weights[..., :1, :]), weights], dim=-2),
        torch.cat([torch.zeros_like(covariance[..., :1, :, :, :]), covariance], dim=-4),
        torch.cat([only(torch.ones_like(mask[..., :1, :]), known, other=False), mask], dim=-2),
    )


@without_autocast
def weights_from_covariance(covariance: Tensor, *, floor: float = 0.5) -> Tensor:
    """Weights in 1/px from the covariance of matches, as triangulation's covariance reads them.

    1 / sqrt(s^2 + floor^2), with s^2 the mean variance over the two axes: half the trace, which
    no turn of the image changes. Triangulation takes the noise of a view as round; this is the
    round noise with the same mean squared error.

    Args:
        covariance: ``(*B, 2, 2)`` px^2, for example of :class:`Matches`.
        floor: px, what a match errs even where its distribution is sharp: the localisation of
            keypoints, the spacing of samples, errors of poses. It bounds all weights, and a
            match without variance, such as the anchor's, has the weight 1 / floor.

    Returns:
        ``(*B)`` between 0 and 1 / floor. A variance that is NaN or infinite, or below 0 by more
        than the floor, has the weight 0: unused.

    Raises:
        ShapeError: the covariance is not ``(*B, 2, 2)``.
        ValueError: the floor is not positive.

    Example:
        >>> matched = torch.diag(torch.tensor([24.0, 7.5]))  # px^2
        >>> weights_from_covariance(torch.stack([0 * matched, matched]), floor=0.5)
        tensor([2.0000, 0.2500])
    """
    check_shapes(covariance=(covariance, "2 2"))
    check_positive(floor=floor)
    variance = (covariance[..., 0, 0] + covariance[..., 1, 1]) / 2 + floor**2
    known = unless_all(variance.isfinite() & (variance > 0))
    # Double where: the unused branch must not turn the gradient into NaN.
    return only(only(variance, known, other=1.0).rsqrt(), known)


@without_autocast
def match_per_view(
    keypoints: Tensor, scores: Tensor, samples: Samples, *, window: int | None = None
) -> Matches:
    """Match in every source alone: soft-argmax over all its samples, weight = peak.

    The peak is a probability, without unit, and falls as samples get denser: a weight of 0.5 does
    not mean noise of 2 px. See :func:`weights_from_covariance`.

    Args:
        keypoints: ``(*B, N, 2)`` of the anchor.
        scores: ``(*B, V-1, N, O, S)`` logits, for example a scaled :func:`deltas_geom.correlate`;
            those that are not finite count as masked.
        samples: the places scored.
        window: see :func:`soft_argmax`; only without offsets (O = 1).

    Raises:
        ShapeError: scores are of other samples.

    Source: the paper, section 3.2, equations 2 and 3.
    """
    check_scores(keypoints, scores, samples, "sources N O S")
    if window is not None and scores.shape[-2] != 1:
        raise ValueError("window needs samples without offsets: steps are along one line")
    found = soft_argmax(
        scores.flatten(-2),
        samples.pixels.flatten(-3, -2),
        mask=samples.mask.flatten(-2),
        window=window,
    )
    # The largest of S probabilities is 1 / S or more, where any place is possible.
    return matches_from_sources(
        keypoints, found.position, found.peak, found.covariance, found.peak > 0
    )


@without_autocast
def match_joint(
    views: PosedViews,
    keypoints: Tensor,
    scores: Tensor,
    samples: Samples,
    *,
    image_size: tuple[int, int],
    window: int | None = 2,
) -> Matches:
    """Match in all sources at once: mean score at common inverse depths, one soft-argmax.

    All sources of a keypoint share one weight, the peak's probability, without unit; see
    :func:`weights_from_covariance`. Their errors are one error of depth, not independent ones.

    Args:
        views: the anchor (view 0) and its V-1 sources.
        keypoints: ``(*B, N, 2)`` of the anchor.
        scores: ``(*B, V-1, N, 1, S)`` logits at ``samples``; those that are not finite count as
            not seen in their view.
        samples: from :func:`deltas_geom.sample_inv_depths`.
        image_size: (height, width) of the sources.
        window: see :func:`soft_argmax`.

    Returns:
        The projections of the one decided depth into the sources that can see it, weight =
        peak of the joint distribution. The covariance passes no gradient to the scores.

    Raises:
        ShapeError: scores are of other samples, or there is no source.
        ValueError: each source has inverse depths of its own; not noticed where values are not on
            the CPU, or traced.
    """
    check_scores(keypoints, scores, samples, "+sources N 1 S")
    check_bool(mask=samples.mask)
    scores, finite = finite_or_zero(scores.squeeze(-2), dims=0)
    seen = only(samples.mask.squeeze(-2), finite, other=False)
    count = seen.to(scores.dtype).sum(dim=-3)
    mean = safe_divide(only(scores, seen).sum(dim=-3), count, count > 0)
    inv_depth = samples.inv_depth.select(-3, 0)
    if values_at_hand(inv_depth) and bool((samples.inv_depth != inv_depth.unsqueeze(-3)).any()):
        raise ValueError("samples must have one inv_depth for all sources: use sample_inv_depths")
    found = soft_argmax(mean, inv_depth[..., None], mask=count > 0, window=window)
    return matches_at(
        views,
        keypoints,
        found.position.squeeze(-1),
        found.covariance[..., 0, 0],
        weights=found.peak,
        image_size=image_size,
    )


def matches_at(
    views: PosedViews,
    keypoints: Tensor,
    inv_depth: Tensor,
    variance: Tensor,
    *,
    weights: Tensor,
    image_size: tuple[int, int],
) -> Matches:
    """The matches that one inverse depth per keypoint implies; its variance in 1/m^2."""
    at = torch.stack([inv_depth, inv_depth + variance.clamp_min(0).sqrt().detach()], dim=-1)
    places = sample_inv_depths(views, keypoints, at, image_size=image_size)
    pixels, beside = places.pixels.squeeze(-3).unbind(dim=-2)
    step = torch.where(places.mask.squeeze(-2).all(-1)[..., None], beside - pixels, 0.0)
    seen = places.mask[..., 0, 0]
    return matches_from_sources(
        keypoints,
        pixels,
        weights.unsqueeze(-2).expand(seen.shape),
        step[..., :, None] * step[..., None, :],
        seen,
    )
