"""From keypoints to matches: the paper's matcher and the joint one.

Both return matches that go straight into triangulation, the posterior they come from, and one
confidence per point. The joint matcher first finds the depth on which all views agree, then
lets every view move its match a little towards what it sees.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from deltas_geom import (
    Matches,
    PosedViews,
    correlate,
    epipolar_segments,
    match_per_view,
    sample_inv_depths,
    sample_map,
    sample_segments,
    soft_argmax,
)
from deltas_geom.matching import matches_at
from deltas_nets.config import MatcherConfig
from deltas_nets.network.context import Context, smooth_scores
from deltas_nets.network.descriptor import WIDTH, Descriptors
from deltas_nets.network.refine import RefineMatches


class Posterior(NamedTuple):
    """Belief over inverse depth, as the cross-entropy loss wants it.

    Attributes:
        stages: logits ``(B, V-1 or 1, N, S)`` after each round; the last one decides.
        inv_depth: ``(B, V-1 or 1, N, S)`` or broadcastable, 1/m.
        mask: ``(B, V-1 or 1, N, S)`` bool.
    """

    stages: tuple[Tensor, ...]
    inv_depth: Tensor
    mask: Tensor


class Matched(NamedTuple):
    """What a matcher found.

    Attributes:
        matches: of all views, ready to triangulate.
        confidence: ``(B, N)`` probability that the depth is right.
        posterior: where it comes from.
    """

    matches: Matches
    confidence: Tensor
    posterior: Posterior


class JointMatcher(nn.Module):
    """Fuses all views at common inverse depths before it decides."""

    def __init__(self, config: MatcherConfig, descriptor_dim: int) -> None:
        super().__init__()
        self.config = config
        self.log_scale = nn.Parameter(torch.tensor(2.77))  # logits per unit of correlation
        self.visibility = nn.Parameter(torch.tensor(4.0))
        self.smooth = smooth_scores(2)
        self.context = Context(
            descriptor_dim + WIDTH, rounds=config.context_rounds, heads=config.context_heads
        )
        self.confidence = nn.Sequential(nn.Linear(4, 16), nn.ReLU(), nn.Linear(16, 1))
        self.refine = RefineMatches(config.refine_radius)

    def forward(
        self,
        keypoints: Tensor,
        descriptors: Descriptors,
        views: PosedViews,
        *,
        image_size: tuple[int, int],
        depth_range: tuple[float, float],
    ) -> Matched:
        """Match ``(B, N, 2)`` keypoints of the anchor in all sources at once."""
        near, far = depth_range
        inv_depths = torch.linspace(
            1 / far, 1 / near, self.config.num_samples, device=keypoints.device
        )
        samples = sample_inv_depths(views, keypoints, inv_depths, image_size=image_size)
        anchor = _at_keypoints(descriptors, keypoints, image_size)
        correlation = correlate(anchor, descriptors.maps[:, 1:], samples, image_size=image_size)
        correlation, seen = correlation.squeeze(-2), samples.mask.squeeze(-2)
        stages, fused = self._posterior(
            correlation, seen, anchor, descriptors, keypoints, image_size
        )

        found = soft_argmax(stages[-1], inv_depths[:, None], window=self.config.window)
        best = stages[-1].argmax(dim=-1, keepdim=True)
        agreement = fused.gather(-1, best).squeeze(-1)
        sources = seen.any(dim=-1).sum(dim=1) / 4
        evidence = torch.stack([found.mass, agreement, found.entropy / 3, sources], dim=-1)
        confidence = self.confidence(evidence).squeeze(-1).sigmoid()
        confidence = torch.where(seen.any(dim=-1).any(dim=1), confidence, 0.0)

        matches = matches_at(
            views,
            keypoints,
            found.position.squeeze(-1).clamp(min=1 / far),
            found.covariance[..., 0, 0],
            weights=torch.ones_like(confidence),
            image_size=image_size,
        )
        matches = self.refine(matches, anchor, descriptors.maps, image_size=image_size)
        posterior = Posterior(
            tuple(stage.unsqueeze(1) for stage in stages), inv_depths, seen.any(1, keepdim=True)
        )
        return Matched(matches, confidence, posterior)

    def _posterior(
        self,
        correlation: Tensor,
        seen: Tensor,
        anchor: Tensor,
        descriptors: Descriptors,
        keypoints: Tensor,
        image_size: tuple[int, int],
    ) -> tuple[list[Tensor], Tensor]:
        """Logits ``(B, N, S)`` of every stage, and the fused correlation."""
        # Views that see the point agree with it better than those it is hidden from.
        weight = seen * (self.visibility * correlation).exp()
        total = weight.sum(dim=1)
        fused = (weight * correlation).sum(dim=1) / total.clamp_min(1e-6)
        fused = torch.where(seen.any(dim=1), fused, -0.2)
        share = seen.float().mean(dim=1)
        rows = torch.stack([fused, share], dim=2).flatten(0, 1)
        fused = fused + self.smooth(rows).view_as(fused)
        context = sample_map(descriptors.context[:, 0], keypoints, image_size=image_size)
        stages = self.context(
            fused * self.log_scale.exp(),
            torch.cat([anchor, context], dim=-1),
            keypoints / image_size[1],
        )
        return stages, fused


class PerViewMatcher(nn.Module):
    """The paper's: each source decides alone, weighted DLT reconciles them."""

    def __init__(self, config: MatcherConfig, descriptor_dim: int) -> None:
        super().__init__()
        self.config = config
        self.norm = nn.BatchNorm1d(1)
        self.log_scale = nn.Parameter(torch.tensor(2.0))

    def forward(
        self,
        keypoints: Tensor,
        descriptors: Descriptors,
        views: PosedViews,
        *,
        image_size: tuple[int, int],
        depth_range: tuple[float, float],
    ) -> Matched:
        """Match ``(B, N, 2)`` keypoints of the anchor in each source alone."""
        segments = epipolar_segments(
            views, keypoints, depth_range=depth_range, image_size=image_size
        )
        samples = sample_segments(
            segments, self.config.num_samples, offsets=self.config.offsets, image_size=image_size
        )
        anchor = _at_keypoints(descriptors, keypoints, image_size)
        correlation = correlate(anchor, descriptors.maps[:, 1:], samples, image_size=image_size)
        normed = self.norm(correlation.reshape(-1, 1)).view_as(correlation).relu()
        scores = normed * self.log_scale.exp()
        matches = match_per_view(keypoints, scores, samples)
        along = torch.where(samples.mask, scores, torch.finfo(scores.dtype).min / 4)
        posterior = Posterior(
            (along.logsumexp(dim=-2),), samples.inv_depth, samples.mask.any(dim=-2)
        )
        confidence = torch.where(matches.mask, matches.weights, 0.0)[:, 1:].amax(dim=1)
        return Matched(matches, confidence, posterior)


def _at_keypoints(
    descriptors: Descriptors, keypoints: Tensor, image_size: tuple[int, int]
) -> Tensor:
    """Unit descriptors ``(B, N, D)`` of the anchor's keypoints."""
    return F.normalize(sample_map(descriptors.maps[:, 0], keypoints, image_size=image_size), dim=-1)


Matcher = JointMatcher | PerViewMatcher


def build_matcher(config: MatcherConfig, descriptor_dim: int) -> Matcher:
    """The matcher a config names."""
    kinds: dict[str, type[JointMatcher] | type[PerViewMatcher]] = {
        "joint": JointMatcher,
        "per_view": PerViewMatcher,
    }
    return kinds[config.kind](config, descriptor_dim)
