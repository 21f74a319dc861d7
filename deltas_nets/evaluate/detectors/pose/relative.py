"""Pose of one camera in another's coordinates, up to the length of the baseline."""

import torch
from kornia.geometry.epipolar import find_essential, motion_from_essential_choose_solution
from torch import Tensor

from deltas_geom.checks import check_shapes
from deltas_geom.epipolar.fundamental import cross_matrix, inverse_intrinsics
from deltas_nets.evaluate.detectors.pose.consensus import (
    Consensus,
    ConsensusConfig,
    find_consensus,
)
from deltas_nets.evaluate.detectors.pose.refine import refine_pose

__all__ = ["relative_pose_from_matches"]


def relative_pose_from_matches(
    first: Tensor, second: Tensor, K: Tensor, config: ConsensusConfig
) -> Consensus | None:
    """The relative pose that most matches agree with, by five of them.

    Args:
        first: ``(N, 2)`` pixels of the first view.
        second: ``(N, 2)`` pixels of the second view, matched to them.
        K: ``(2, 3, 3)`` of both.
        config: the threshold is of Sampson's distance, in pixels of the two cameras' mean
            focal length.

    Returns:
        second_from_first ``(4, 4)`` float64, its translation of unit length, and its inliers; None
        if there are fewer than six matches or no sample has a solution.

    Raises:
        ShapeError: a trailing shape differs.

    Source: Nister, An efficient solution to the five-point relative pose problem (2004), as kornia
    has it; Hartley and Zisserman, 2nd ed., section 9.6 (which of four poses) and equation 11.9
    (Sampson's distance).
    """
    check_shapes(first=(first, "N 2"), second=(second, "N 2"), K=(K, "2 3 3"))
    if len(first) < 6:  # five agree with some pose always
        return None
    K = K.double()
    focal = float(K[:, [0, 1], [0, 1]].mean())
    one, two = (
        torch.nn.functional.pad(pixels.double(), (0, 1), value=1.0) @ inverse_intrinsics(k).mT
        for pixels, k in zip((first, second), K, strict=True)
    )

    def solve(samples: Tensor) -> Tensor:
        found: Tensor = find_essential(one[samples][..., :2], two[samples][..., :2])
        return found.flatten(0, 1)

    def squared(essential: Tensor) -> Tensor:
        return focal**2 * _sampson(essential, one, two).square()

    def refine(essential: Tensor, inliers: Tensor) -> Tensor:
        pose = refine_pose(
            _motion(essential, one, two, inliers),
            lambda tried: _sampson(_essential(tried)[None], one[inliers], two[inliers])[0],
        )
        return _essential(pose)

    found = find_consensus(len(one), 5, solve=solve, squared=squared, refine=refine, config=config)
    if found is None:
        return None
    return found._replace(model=_motion(found.model, one, two, found.inliers))


def _sampson(essential: Tensor, one: Tensor, two: Tensor) -> Tensor:
    """Signed distances ``(M, N)`` in the plane at depth 1."""
    lines, back = one @ essential.mT, two @ essential  # in the second view, in the first
    value = (lines * two).sum(dim=-1)
    size = lines[..., :2].square().sum(dim=-1) + back[..., :2].square().sum(dim=-1)
    return value / size.clamp(min=1e-24).sqrt()


def _essential(pose: Tensor) -> Tensor:
    translation = torch.nn.functional.normalize(pose[:3, 3], dim=0)
    return cross_matrix(translation) @ pose[:3, :3]


def _motion(essential: Tensor, one: Tensor, two: Tensor, inliers: Tensor) -> Tensor:
    """Of the four poses the one that has most inliers ahead of both cameras."""
    eye = torch.eye(3).to(essential)
    found = motion_from_essential_choose_solution(
        essential, eye, eye, one[:, :2], two[:, :2], mask=inliers
    )
    pose = torch.eye(4).to(essential)
    pose[:3, :3] = found[0]
    pose[:3, 3] = torch.nn.functional.normalize(found[1][:, 0], dim=0)
    return pose
