"""Whether views that agree two by two agree in threes.

A pair of views knows nothing of an error along its epipolar lines: of cameras in a row each may
stand anywhere in it, or have a unit of its own. The point that three of them see tells.
"""

import torch
from torch import Tensor

from deltas_geom.cameras.projection import project
from deltas_geom.cameras.views import PosedViews
from deltas_geom.diagnosis.evidence import CAP, CHANCE, SHARE
from deltas_geom.triangulation.robust import triangulate_robust

_CONFIRMED = 0.1  # of a camera's pixels; with 30 % wrong ones three views leave a quarter
_MOST = 1024  # points looked at


def off_in_threes(
    K: Tensor, pose: Tensor, pixels: Tensor, seen: Tensor, threshold: float
) -> Tensor:
    """How far off the cameras are whose pixels hardly ever fit a point of two other views.

    ``(V)`` px, the median of what is off by more than ``threshold``; 0 for all other cameras.
    Pixels are ``(V, N, 2)`` float64, finite where ``seen``.
    """
    points = (seen.sum(dim=0) >= 3).nonzero().squeeze(-1)
    if not len(points):
        return pixels.new_zeros(len(K))
    points = points[:: 1 + len(points) // _MOST]
    pixels, seen = pixels[:, points], seen[:, points]
    found = triangulate_robust(K @ pose[:, :3], pixels, mask=seen, threshold=threshold)
    fit = found.inliers & (found.inliers.sum(dim=0) >= 3)
    counts = seen.sum(dim=-1)
    limit = (SHARE - CHANCE / counts.sqrt()).clamp(max=_CONFIRMED)
    apart = fit.sum(dim=-1) / counts < limit  # not of so few that chance may be against them
    there = project(PosedViews(K, pose), found.points)
    off = (there.pixels - pixels).norm(dim=-1).clamp(max=CAP)
    off = torch.where(there.in_front & found.valid, off, CAP)
    off = torch.where(seen & ~found.inliers, off, torch.nan).nanmedian(dim=-1).values
    return torch.where(apart, off.nan_to_num(), 0.0)
