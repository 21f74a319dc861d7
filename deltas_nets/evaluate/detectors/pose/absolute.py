"""Pose of a camera from points of the world and where it sees them (PnP)."""

import torch
from torch import Tensor

from deltas_geom.checks import check_shapes
from deltas_geom.epipolar.fundamental import inverse_intrinsics
from deltas_nets.evaluate.detectors.pose.consensus import (
    Consensus,
    ConsensusConfig,
    find_consensus,
)
from deltas_nets.evaluate.detectors.pose.p3p import solve_p3p
from deltas_nets.evaluate.detectors.pose.refine import refine_pose

__all__ = ["absolute_pose"]


def absolute_pose(
    points: Tensor, pixels: Tensor, K: Tensor, config: ConsensusConfig
) -> Consensus | None:
    """The pose that most matches agree with, by three of them and least squares over inliers.

    Args:
        points: ``(N, 3)`` of the world, metres.
        pixels: ``(N, 2)`` where the camera is thought to see them.
        K: ``(3, 3)``.
        config: the threshold is of the distance between projection and pixel.

    Returns:
        cam_from_world ``(4, 4)`` float64 and its inliers; None if there are fewer than four
        matches or no sample has a solution.

    Raises:
        ShapeError: a trailing shape differs.

    Source: Hartley and Zisserman, 2nd ed., section 7.3 (restricted camera estimation) and 7.2
    (geometric error); Ke and Roumeliotis (CVPR 2017).
    """
    check_shapes(points=(points, "N 3"), pixels=(pixels, "N 2"), K=(K, "3 3"))
    if len(points) < 4:  # three agree with some pose always
        return None
    points, pixels, K = points.double(), pixels.double(), K.double()
    rays = torch.nn.functional.pad(pixels, (0, 1), value=1.0) @ inverse_intrinsics(K).mT
    rays = torch.nn.functional.normalize(rays, dim=-1)

    def solve(samples: Tensor) -> Tensor:
        return solve_p3p(points[samples], rays[samples]).flatten(0, 1)

    def squared(poses: Tensor) -> Tensor:
        # Thousands of poses at once: deltas_geom.project checks more than is needed here.
        seen = points @ poses[:, :3, :3].mT + poses[:, None, :3, 3]
        image = seen @ K.mT
        offset = image[..., :2] / image[..., 2:] - pixels
        return torch.where(seen[..., 2] > 0, offset.square().sum(dim=-1), torch.inf)

    def refine(pose: Tensor, inliers: Tensor) -> Tensor:
        world, seen = points[inliers], pixels[inliers]

        def offsets(tried: Tensor) -> Tensor:
            image = (world @ tried[:3, :3].mT + tried[:3, 3]) @ K.mT
            return (image[:, :2] / image[:, 2:] - seen).flatten()

        return refine_pose(pose, offsets)

    return find_consensus(
        len(points), 3, solve=solve, squared=squared, refine=refine, config=config
    )
