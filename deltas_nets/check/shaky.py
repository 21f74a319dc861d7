"""Poses that are each a little off: every pair of frames fits better with a rotation of its own."""

import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import to_homogeneous
from deltas_geom.epipolar.fundamental import cross_matrix
from deltas_nets.check.finding import Fault, Finding
from deltas_nets.check.trying import Case

__all__ = ["shaky_poses"]

LEAST_MATCHES = 48  # of a pair: three angles cannot explain so many by accident
LEAST_PAIRS = 6
OFF = 0.7
"""px at the size that frames are looked at, from which on depth is worse. Clean captures leave as
much where baselines are wide, but there a rotation changes little."""
LEFT = 0.45
"""Of the residuals, at most, with rotations of their own: 0.3 where poses shake by 5 mm and 0.3
degrees, 0.6 to 1 of captures as sensors, motion capture and COLMAP track them."""
_STEPS = 8


def shaky_poses(case: Case) -> Finding | None:
    """The finding, if poses shake."""
    before, after, angles = own_rotations(case)
    if len(before) < LEAST_PAIRS:
        return None
    given, left = float(before.median()), float(after.median())
    if given < OFF or left > LEFT * given:
        return None
    evidence = (
        f"matches are {given:.2g} px off as given, {left:.2g} px where each pair of frames is "
        f"turned by {float(angles.rad2deg().median()):.2g} degrees of its own"
    )
    cure = (
        "refine the poses with these images (bundle adjustment, as COLMAP's bundle_adjuster does), "
        "or track a camera again that moves slowly and exposes for a short time"
    )
    return Finding(Fault.POSES_SHAKE, evidence, (), cure, "warning")


def own_rotations(case: Case) -> tuple[Tensor, Tensor, Tensor]:
    """Of each pair with matches enough, what rotations change: three times ``(P)``.

    Returns:
        Medians of distances from epipolar lines (Sampson's) as given and with a rotation of its
        own, px, and the angle of that, rad.
    """
    evidence = case.evidence.of(case.evidence.counts >= LEAST_MATCHES)
    K, pose = case.matched.views(case.capture.frames)
    a, b = evidence.pairs.unbind(dim=-1)
    turn = pose[b, :3, :3] @ pose[a, :3, :3].mT
    baseline = pose[b, :3, 3] - (turn @ pose[a, :3, 3:])[..., 0]
    baseline = baseline / baseline.norm(dim=-1, keepdim=True).clamp(min=1e-12)
    there = evidence.first.isfinite().all(dim=-1)
    inverse = torch.linalg.inv(K)
    from_a, from_b = inverse[a], inverse[b]
    x = to_homogeneous(evidence.first.nan_to_num()) @ from_a.mT
    y = to_homogeneous(evidence.second.nan_to_num()) @ from_b.mT
    axes = cross_matrix(torch.eye(3).to(pose))

    def distances(rotation: Tensor) -> tuple[Tensor, Tensor]:
        """``(P, M)`` px, and their slopes ``(P, M, 3)`` by angles, rad."""
        essential = cross_matrix(baseline) @ rotation
        in_b, in_a = x @ essential.mT @ from_b, y @ essential @ from_a
        squared = in_b[..., :2].square().sum(dim=-1) + in_a[..., :2].square().sum(dim=-1)
        scale = squared.clamp(min=1e-18).rsqrt()
        slopes = cross_matrix(baseline)[:, None] @ axes @ rotation[:, None]
        bent = (y[:, None] * (x[:, None] @ slopes.mT)).sum(dim=-1)
        return (y * (x @ essential.mT)).sum(dim=-1) * scale, bent.mT * scale[..., None]

    def median(off: Tensor) -> Tensor:
        return torch.where(there, off.abs(), torch.nan).nanmedian(dim=-1).values

    rotation = turn
    before = after = median(distances(turn)[0])
    best = turn
    for _ in range(_STEPS):
        off, slopes = distances(rotation)
        weights = there / (1 + off.square())  # Cauchy's: wrong matches have no say
        normal = (slopes * weights[..., None]).mT @ slopes
        # A thousandth keeps angles still that move nothing.
        normal = normal + 1e-3 * torch.diag_embed(normal.diagonal(dim1=-2, dim2=-1) + 1e-9)
        wanted = (slopes * (weights * off)[..., None]).sum(dim=-2)
        step = -torch.linalg.solve(normal, wanted)
        rotation = torch.linalg.matrix_exp(cross_matrix(step)) @ rotation
        left = median(distances(rotation)[0])
        better = left < after
        best = torch.where(better[:, None, None], rotation, best)
        after = torch.where(better, left, after)
    traces = (best * turn).sum(dim=(-2, -1))
    return before, after, ((traces - 1) / 2).clamp(-1, 1).arccos()
