"""A second look at a point's confidence, once it is triangulated.

The matcher is sure of a depth before it knows whether the views' rays meet there. What
triangulation tells corrects its confidence, and nothing else: none of it passes a gradient, for a
point must not be moved to look right.
"""

import torch
from torch import Tensor, nn

from deltas_geom import Matches, PosedViews, Triangulation
from deltas_geom.cameras.homogeneous import safe_divide
from deltas_geom.numerics.arithmetic import without_gradients
from deltas_nets.network.joint.context import WIDTH
from deltas_nets.network.joint.parallax import parallax_of, relative_error_per_pixel
from deltas_nets.network.layers import WideLinear
from deltas_nets.network.records import Chosen, Posterior

NUM_CLUES = 14


class Judge(nn.Module):
    """Corrects the logit of a confidence; it starts with no correction.

    Args:
        window: samples to either side of the posterior's peak that belong to the peak.
    """

    def __init__(self, window: int) -> None:
        super().__init__()
        self.window = window
        last = WideLinear(32, 1)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.correction = nn.Sequential(WideLinear(WIDTH + NUM_CLUES, 32), nn.ReLU(), last)

    def forward(
        self,
        chosen: Chosen,
        matches: Matches,
        posterior: Posterior,
        points: Triangulation,
        views: PosedViews,
    ) -> Tensor:
        """Confidence ``(B, N)``, 0 where no source can see the point at any depth.

        Args:
            chosen: of the matcher.
            matches: as they were triangulated, ``(B, V, N)``.
            posterior: of the matcher.
            points: triangulated from the matches.
            views: ``(B, V)``.
        """
        clues = torch.cat(
            [
                chosen.evidence.detach(),
                of_triangulation(chosen, matches, points, views),
                of_refinement(chosen, matches),
                of_posterior(posterior, window=self.window),
            ],
            dim=-1,
        )
        # The embedding alone may learn to tell more about confidence.
        known = torch.cat([chosen.embedding, clues], dim=-1)
        logit = chosen.logit + self.correction(known).squeeze(-1)
        return torch.where(chosen.seen, logit.sigmoid(), 0.0)


@without_gradients
def of_triangulation(
    chosen: Chosen, matches: Matches, points: Triangulation, views: PosedViews
) -> Tensor:
    """Do the rays meet, at a good angle, where the matcher expected it? ``(B, N, 5)``, bounded.

    Residual and parallax by their size, the depth's relative deviation that follows from the
    matches' covariance, how far the depth is from the decided one, and whether there is a point.
    """
    used = matches.mask[:, 1:]
    count = used.sum(dim=1)
    variance = matches.covariance[:, 1:].diagonal(dim1=-2, dim2=-1).mean(dim=-1)  # px^2
    deviation = _mean(variance, used, count).clamp(1e-2, 1e2).sqrt()
    parallax = parallax_of(views, points, used)
    relative = deviation * relative_error_per_pixel(views, parallax)
    ratio = (points.depth[:, 0] * chosen.inv_depth).clamp(0.1, 10.0)
    return torch.stack(
        [
            points.residual.clamp(1e-2, 1e2).log10(),
            parallax.clamp(1e-3, 1.0).log10() + 1,
            relative.clamp(1e-4, 1.0).log10() + 2,
            torch.where(points.valid, ratio, 10.0).log().abs(),
            points.valid.to(ratio.dtype),
        ],
        dim=-1,
    )


@without_gradients
def of_refinement(chosen: Chosen, matches: Matches) -> Tensor:
    """How far views moved their matches, how much they trust them, how many: ``(B, N, 3)``."""
    used = matches.mask[:, 1:]
    count = used.sum(dim=1)
    moved = _mean(chosen.moved, used, count).clamp_max(10.0)  # px
    trust = _mean(matches.weights[:, 1:], used, count)
    return torch.stack([moved, trust, count.clamp_max(16) / 4], dim=-1)


@without_gradients
def of_posterior(posterior: Posterior, *, window: int) -> Tensor:
    """Is there a second depth, and did the points around change this one's? ``(B, N, 2)``, bounded.

    The logit by which the peak exceeds everything outside its window, and the bins between the
    first stage's peak and the last one's.
    """
    first, last = posterior.stages[0].squeeze(1), posterior.stages[-1].squeeze(1)  # (B, N, S)
    peak, place = last.max(dim=-1, keepdim=True)
    bins = torch.arange(last.shape[-1], device=last.device)
    near = (bins - place).abs() <= window
    second = torch.where(near, torch.finfo(last.dtype).min, last).amax(dim=-1)
    margin = (peak.squeeze(-1) - second).clamp(0, 10) / 5
    jumped = (place.squeeze(-1) - first.argmax(dim=-1)).abs().to(last.dtype).log1p()
    return torch.stack([margin, jumped], dim=-1)


def _mean(values: Tensor, used: Tensor, count: Tensor) -> Tensor:
    """The mean ``(B, N)`` of ``(B, V-1, N)`` over the used views; 0 where there is none."""
    return safe_divide(torch.where(used, values, 0.0).sum(dim=1), count, count > 0)
