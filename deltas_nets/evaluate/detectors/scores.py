"""What is said of a detector on one pair of views, and on many.

Source: the paper, section 4.2: the protocol of SuperPoint (DeTone et al. 2018, appendix), where
views are related by depth and pose instead of homographies.
"""

import math
from collections.abc import Sequence
from statistics import median
from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom import PosedViews, unproject
from deltas_geom.cameras.pixels import in_image
from deltas_geom.cameras.poses import camera_centers
from deltas_nets.evaluate.detectors.features import Features
from deltas_nets.evaluate.detectors.matched import mutual_nearest
from deltas_nets.evaluate.detectors.pose.absolute import absolute_pose
from deltas_nets.evaluate.detectors.pose.consensus import ConsensusConfig
from deltas_nets.evaluate.repeatability import (
    DEPTH_TOLERANCE,
    Repeatability,
    pooled,
    repeatability,
    seen_by_other,
)
from deltas_nets.losses.targets import read_nearest

__all__ = [
    "DetectorScores",
    "PairScores",
    "PoseError",
    "pool",
    "pose_error",
    "score_pair",
    "share_within",
]

ROTATION, TRANSLATION = 5.0, 0.05
"""Degrees and metres within which a pose is right (the paper)."""


class PoseError(NamedTuple):
    """How far a pose is off; infinite where none was found.

    Attributes:
        rotation: degrees.
        translation: metres between the cameras' centres.
        direction: degrees between the directions of the baselines.
    """

    rotation: float
    translation: float
    direction: float


NO_POSE = PoseError(math.inf, math.inf, math.inf)


class PairScores(NamedTuple):
    """A detector on two views.

    Attributes:
        points: found in each view.
        repeated: of the detector alone.
        matches: mutual nearest neighbours.
        correct: of them, in each direction, how many lie within the tolerance of their true place.
        shared: points of each view whose place the other sees.
        pose: of the second view by PnP from matches whose depth is known in the first.
    """

    points: tuple[int, int]
    repeated: Repeatability
    matches: int
    correct: tuple[int, int]
    shared: tuple[int, int]
    pose: PoseError


class DetectorScores(NamedTuple):
    """A row of table 1: all points of all pairs weigh the same, and all pairs' poses.

    Attributes:
        localisation: MLE, mean distance of repeated points, px.
        matching: MScore, correct matches of the points that the other view sees.
        points: mean number in an image.
        repeatability: points with a partner, of those that could have one.
        one_to_one: pairs, each point with one partner, of the fewer points.
        rotation: share of pairs within 5 degrees.
        translation: share of pairs within 5 cm.
        precision: correct matches of all matches.
        rotation_median: degrees, of all pairs.
        translation_median: metres, of all pairs.
        pairs: how many.
    """

    localisation: float
    matching: float
    points: float
    repeatability: float
    one_to_one: float
    rotation: float
    translation: float
    precision: float
    rotation_median: float
    translation_median: float
    pairs: int

    def without_lengths(self) -> "DetectorScores":
        """What stays of them where nobody knows how long the unit of the world is."""
        return self._replace(translation=math.nan, translation_median=math.nan)


def score_pair(
    views: PosedViews,
    depth: Tensor,
    first: Features,
    second: Features,
    *,
    tolerance: float,
    consensus: ConsensusConfig,
) -> PairScores:
    """Compare the features of two views of a scene.

    Args:
        views: the two cameras, K ``(2, 3, 3)``.
        depth: ``(2, H, W)`` true depth along z, metres, 0 = unknown.
        first: of view 0.
        second: of view 1.
        tolerance: farthest that a partner or a correct match may be from the true place, px.
        consensus: of the pose.
    """
    matches = mutual_nearest(first.descriptors, second.descriptors)
    one, two = first.pixels[matches[:, 0]], second.pixels[matches[:, 1]]
    forth = seen_by_other(views, depth, first.pixels, DEPTH_TOLERANCE)
    back = seen_by_other(views.select([1, 0]), depth.flip(0), second.pixels, DEPTH_TOLERANCE)
    there, here = forth.pixels[matches[:, 0]], back.pixels[matches[:, 1]]
    right = ((there - two).norm(dim=-1) <= tolerance) & forth.counts[matches[:, 0]]
    right_back = ((here - one).norm(dim=-1) <= tolerance) & back.counts[matches[:, 1]]
    return PairScores(
        points=(len(first.pixels), len(second.pixels)),
        repeated=repeatability(views, depth, first.pixels, second.pixels, tolerance=tolerance),
        matches=len(matches),
        correct=(int(right.sum()), int(right_back.sum())),
        shared=(int(forth.counts.sum()), int(back.counts.sum())),
        pose=_pose_of_second(views, depth[0], one, two, consensus),
    )


def pool(pairs: Sequence[PairScores], points: float) -> DetectorScores:
    """All pairs together.

    Args:
        pairs: at least one.
        points: mean number in an image.
    """
    repeated = pooled([pair.repeated for pair in pairs])
    correct = [sum(pair.correct[side] for pair in pairs) for side in (0, 1)]
    shared = [sum(pair.shared[side] for pair in pairs) for side in (0, 1)]
    matches = sum(pair.matches for pair in pairs)
    sides = [c / s if s else math.nan for c, s in zip(correct, shared, strict=True)]
    return DetectorScores(
        localisation=repeated.error,
        matching=sum(sides) / 2 if matches else math.nan,
        points=points,
        repeatability=repeated.share,
        one_to_one=repeated.one_to_one,
        rotation=share_within([pair.pose.rotation for pair in pairs], ROTATION, matches),
        translation=share_within([pair.pose.translation for pair in pairs], TRANSLATION, matches),
        precision=correct[0] / matches if matches else math.nan,
        rotation_median=median(pair.pose.rotation for pair in pairs),
        translation_median=median(pair.pose.translation for pair in pairs),
        pairs=len(pairs),
    )


def pose_error(estimated: Tensor | None, true: Tensor) -> PoseError:
    """How far one cam_from_world ``(4, 4)`` is from another; infinitely if there is none.

    Example:
        >>> moved = torch.eye(4)
        >>> moved[0, 3] = 0.03
        >>> round(pose_error(moved, torch.eye(4)).translation, 6)
        0.03
    """
    if estimated is None:
        return NO_POSE
    estimated, true = estimated.double(), true.double()
    turn = estimated[:3, :3] @ true[:3, :3].mT
    # The sine besides the cosine, which is flat near 0 degrees.
    sine = torch.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    angle = torch.atan2(sine.norm(), turn.trace() - 1)
    centers = camera_centers(torch.stack([estimated, true]))
    unit = torch.nn.functional.normalize(centers, dim=-1)
    between = torch.atan2(torch.linalg.cross(unit[0], unit[1]).norm(), (unit[0] * unit[1]).sum())
    return PoseError(
        math.degrees(float(angle)),
        float((centers[0] - centers[1]).norm()),
        math.degrees(float(between)),
    )


def share_within(errors: Sequence[float], limit: float, matches: int = 1) -> float:
    """How many of the errors are within a limit, in [0, 1]; NaN where nothing was matched."""
    if not matches or not errors:
        return math.nan
    return sum(error <= limit for error in errors) / len(errors)


def _pose_of_second(
    views: PosedViews, depth: Tensor, one: Tensor, two: Tensor, config: ConsensusConfig
) -> PoseError:
    size = (depth.shape[-2], depth.shape[-1])
    known = torch.where(in_image(one, image_size=size), read_nearest(depth, one), 0.0)
    use = known > 0
    anchor = views.select([0])
    points = unproject(anchor, one[None, use], known[None, use])[0]
    found = absolute_pose(points, two[use], views.K[1], config)
    # In the first camera's coordinates, whose origin the direction of a baseline starts at.
    of_anchor = torch.linalg.inv(anchor.cam_from_world[0].double())
    true = views.cam_from_world[1].double() @ of_anchor
    return pose_error(None if found is None else found.model @ of_anchor, true)
