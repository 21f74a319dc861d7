"""The joint matcher finds where the anchor's keypoints are in the other views.

Matches go straight into triangulation, with the posterior they come from and one confidence per
point. First the matcher finds the depth on which all views agree, then it lets every view move its
match a little towards what it sees. The paper's is in `per_view_matcher`.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from deltas_geom import (
    PosedViews,
    correlate,
    sample_inv_depths,
    sample_map,
    soft_argmax,
)
from deltas_geom.matching.matches import matches_at
from deltas_nets.config import MatcherConfig
from deltas_nets.network.joint.context import Context, smooth_scores
from deltas_nets.network.joint.inverse_depths import (
    best_of_bins,
    bin_centres,
    samples_per_bin,
    subdivide,
)
from deltas_nets.network.joint.refine import RefineMatches
from deltas_nets.network.layers import WideLinear
from deltas_nets.network.lite.descriptor import WIDTH, Descriptors
from deltas_nets.network.records import Chosen, Matched, Posterior


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
        self.confidence = nn.Sequential(WideLinear(4, 16), nn.ReLU(), WideLinear(16, 1))
        self.refine = RefineMatches(config.refine_radius)

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
        """Match ``(B, N, 2)`` keypoints of the anchor in all sources at once.

        Without a ``refinement`` the number of samples is read from the device.
        """
        config = self.config
        most = min(refinement or config.max_refinement, config.max_refinement)
        centres = bin_centres(config.num_samples, depth_range, like=keypoints)
        counts = samples_per_bin(
            views,
            keypoints,
            centres,
            step=config.step,
            most=most,
            image_size=image_size,
        )
        places = subdivide(centres, counts, most if refinement else int(counts.max()))
        each = places.flatten(1)[:, None].expand(-1, keypoints.shape[1], -1)
        samples = sample_inv_depths(views, keypoints, each, image_size=image_size)
        anchor = at_keypoints(descriptors, keypoints, image_size)
        correlation = correlate(anchor, descriptors.maps[:, 1:], samples, image_size=image_size)
        seen = samples.mask.squeeze(-2)
        bins = best_of_bins(*self._fused(correlation.squeeze(-2), seen), places, centres)
        fused = bins.score + self.smooth(torch.stack([bins.score, bins.share], dim=1)).squeeze(1)
        context = sample_map(descriptors.context[:, 0], keypoints, image_size=image_size)
        stages, embedding = self.context(
            fused * self.log_scale.exp(),
            torch.cat([anchor, context], dim=-1),
            keypoints / image_size[1],
        )

        found = soft_argmax(stages[-1], bins.inv_depth[..., None], window=config.window)
        best = stages[-1].argmax(dim=-1, keepdim=True)
        agreement = fused.gather(-1, best).squeeze(-1)
        sources = seen.any(dim=-1).sum(dim=1) / 4
        evidence = torch.stack([found.mass, agreement, found.entropy / 3, sources], dim=-1)
        logit = self.confidence(evidence).squeeze(-1)
        inv_depth = found.position.squeeze(-1).clamp(min=1 / depth_range[1])
        decided = matches_at(
            views,
            keypoints,
            inv_depth,
            found.covariance[..., 0, 0],
            weights=torch.ones_like(logit),
            image_size=image_size,
        )
        matches = self.refine(decided, anchor, descriptors.maps, image_size=image_size)
        somewhere = sources > 0
        moved = torch.linalg.vector_norm((matches.pixels - decided.pixels)[:, 1:].detach(), dim=-1)
        return Matched(
            matches,
            torch.where(somewhere, logit.sigmoid(), 0.0),
            Posterior(
                tuple(stage.unsqueeze(1) for stage in stages),
                centres,
                (bins.share > 0).unsqueeze(1),
            ),
            Chosen(inv_depth, logit, somewhere, evidence, embedding, moved),
        )

    def _fused(self, correlation: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
        """Correlation of all sources as one, and the share of them that see it."""
        # Views that see the point agree with it better than those it is hidden from.
        weight = seen * (self.visibility * correlation).exp()
        total = weight.sum(dim=1)
        fused = (weight * correlation).sum(dim=1) / total.clamp_min(1e-6)
        return torch.where(seen.any(dim=1), fused, -0.2), seen.to(fused.dtype).mean(dim=1)


def at_keypoints(
    descriptors: Descriptors, keypoints: Tensor, image_size: tuple[int, int]
) -> Tensor:
    """Unit descriptors ``(B, N, D)`` of the anchor's keypoints."""
    return F.normalize(sample_map(descriptors.maps[:, 0], keypoints, image_size=image_size), dim=-1)
