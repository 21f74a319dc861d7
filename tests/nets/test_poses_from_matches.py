"""Poses from matches: P3P, PnP and essential matrices, beside OpenCV's."""

import math
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import PosedViews, project, unproject
from deltas_geom.checks import ShapeError
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.usable import usable_view_sets
from deltas_nets.captures.work_size import anchor_views, depth_at_image, fit_work_size, load_image
from deltas_nets.evaluate.detectors.config import TableConfig
from deltas_nets.evaluate.detectors.features import DetectionConfig
from deltas_nets.evaluate.detectors.own import ours
from deltas_nets.evaluate.detectors.pairs_file import load_pair, matched_pixels, read_pairs
from deltas_nets.evaluate.detectors.pose.absolute import absolute_pose
from deltas_nets.evaluate.detectors.pose.consensus import ConsensusConfig
from deltas_nets.evaluate.detectors.pose.p3p import solve_p3p
from deltas_nets.evaluate.detectors.pose.refine import moved
from deltas_nets.evaluate.detectors.pose.relative import relative_pose_from_matches
from deltas_nets.evaluate.detectors.registry import load_extractors
from deltas_nets.evaluate.detectors.scores import pose_error, share_within
from deltas_nets.losses.targets import read_nearest

K = torch.tensor([[300.0, 0, 159.5], [0, 310, 119.5], [0, 0, 1]], dtype=torch.float64)
numbers = st.floats(-1, 1, width=32)
motions = st.lists(numbers, min_size=6, max_size=6).map(
    lambda values: torch.tensor(values, dtype=torch.float64)
)
eye = torch.eye(4, dtype=torch.float64)


class Matched(NamedTuple):
    """Points ahead of two cameras, and where each sees them, ``outliers`` of them anywhere."""

    pose: Tensor
    points: Tensor
    first: Tensor
    second: Tensor


def matched(motion: Tensor, *, outliers: float, noise: float = 0.3, count: int = 150) -> Matched:
    random = torch.Generator().manual_seed(3)
    spread = torch.rand(count, 3, generator=random, dtype=torch.float64) - 0.5
    points = spread * torch.tensor([3.0, 2.5, 3]) + torch.tensor([0, 0, 4.0])
    pose = moved(eye, motion)
    cameras = PosedViews(K.expand(2, 3, 3), torch.stack([eye, pose]))
    first, second = project(cameras, points).pixels
    first, second = (
        pixels + noise * torch.randn(pixels.shape, generator=random, dtype=torch.float64)
        for pixels in (first, second)
    )
    wrong = torch.rand(count, generator=random) < outliers
    anywhere = torch.rand(count, 2, generator=random, dtype=torch.float64)
    second[wrong] = anywhere[wrong] * torch.tensor([320.0, 240])
    return Matched(pose, points, first, second)


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ShapeError, match="points must have shape"):
        absolute_pose(torch.zeros(5, 2), torch.zeros(5, 2), K, ConsensusConfig())
    with pytest.raises(ShapeError, match="K must have shape"):
        relative_pose_from_matches(torch.zeros(9, 2), torch.zeros(9, 2), K, ConsensusConfig())


@pytest.mark.parametrize("fields", [{"threshold": 0.0}, {"most": 0}, {"confidence": 1.0}])
def test_a_search_that_makes_no_sense_is_refused(fields: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(fields))):
        ConsensusConfig(**fields)  # type: ignore[arg-type]


@given(
    motion=motions,
    corners=st.lists(st.tuples(numbers, numbers, numbers), min_size=3, max_size=3),
    order=st.permutations(range(3)),
)
def test_three_points_give_the_pose_that_saw_them(
    motion: Tensor, corners: list[tuple[float, float, float]], order: list[int]
) -> None:
    base = torch.tensor([[-1.0, -1, 0], [1, -1, 0.3], [0, 1, -0.2]], dtype=torch.float64)
    seen = base + 0.3 * torch.tensor(corners, dtype=torch.float64) + torch.tensor([0, 0, 4.0])
    seen = seen[order]  # clockwise or counterclockwise
    pose = moved(eye, motion)
    world = (seen - pose[:3, 3]) @ pose[:3, :3]
    poses = solve_p3p(world, F.normalize(seen, dim=-1))
    exists = poses.isfinite().flatten(1).all(dim=1)
    assert (poses[exists] - pose).abs().amax(dim=(1, 2)).min() < 1e-6
    # Each that exists sees the points along the rays, in one direction or the other.
    turned = world @ poses[exists][:, :3, :3].mT + poses[exists][:, None, :3, 3]
    across = torch.linalg.cross(
        F.normalize(turned, dim=-1), F.normalize(seen, dim=-1).expand_as(turned)
    )
    assert across.abs().max() < 1e-5


def test_points_on_a_line_have_no_pose() -> None:
    points = torch.tensor([[0.0, 0, 3], [1, 0, 3], [2, 0, 3]], dtype=torch.float64)
    assert solve_p3p(points, F.normalize(points, dim=-1)).isnan().all()


@settings(max_examples=6)
@given(motion=motions)
def test_pnp_finds_the_pose_among_half_wrong_matches(motion: Tensor) -> None:
    scene = matched(0.3 * motion, outliers=0.5)
    found = absolute_pose(scene.points, scene.second, K, ConsensusConfig())
    assert found is not None
    error = pose_error(found.model, scene.pose)
    assert error.rotation < 0.2 and error.translation < 0.01


def test_a_point_behind_the_camera_does_not_agree() -> None:
    """Though its projection is where the match is."""
    scene = matched(torch.zeros(6).double(), outliers=0.0)
    points = scene.points.clone()
    points[:5] = -points[:5]
    found = absolute_pose(points, scene.first, K, ConsensusConfig())
    assert found is not None
    assert found.inliers.tolist() == [False] * 5 + [True] * (len(points) - 5)


@settings(max_examples=6)
@given(motion=motions)
def test_an_essential_matrix_finds_rotation_and_direction(motion: Tensor) -> None:
    motion = 0.2 * motion
    motion[3] = 0.4  # a baseline
    scene = matched(motion, outliers=0.3)
    both = torch.stack([K, K])
    found = relative_pose_from_matches(scene.first, scene.second, both, ConsensusConfig(1.0))
    assert found is not None
    error = pose_error(found.model, scene.pose)
    assert error.rotation < 0.7 and error.direction < 5
    assert_close(found.model[:3, 3].norm(), torch.ones((), dtype=torch.float64))


def test_the_same_seed_gives_the_same_pose_and_too_few_matches_none() -> None:
    scene = matched(torch.tensor([0.1, 0, 0, 0.2, 0, 0], dtype=torch.float64), outliers=0.6)
    one, two = (absolute_pose(scene.points, scene.second, K, ConsensusConfig()) for _ in range(2))
    assert one is not None and two is not None and torch.equal(one.model, two.model)
    few = slice(0, 3)
    assert absolute_pose(scene.points[few], scene.second[few], K, ConsensusConfig()) is None


def test_pnp_is_as_near_as_opencv() -> None:
    for number in range(5):
        motion = torch.tensor([0.1, -0.2, 0.05, 0.1 * number, 0, 0.1], dtype=torch.float64)
        scene = matched(motion, outliers=0.4, noise=0.5)
        found = absolute_pose(scene.points, scene.second, K, ConsensusConfig())
        ok, turn, shift, _ = cv2.solvePnPRansac(
            scene.points.numpy(), scene.second.numpy(), K.numpy(), None, reprojectionError=3.0
        )
        assert ok and found is not None
        theirs = pose_error(of_opencv(cv2.Rodrigues(turn)[0], shift), scene.pose)
        assert pose_error(found.model, scene.pose).translation < 1.5 * theirs.translation + 1e-3


@given(motion=motions)
def test_an_error_is_that_of_the_motion(motion: Tensor) -> None:
    turn = motion.clone()
    turn[3:] = 0
    angle = math.degrees(float(turn[:3].norm()))
    assert_close(pose_error(moved(eye, turn), eye).rotation, angle, rtol=0, atol=1e-6)
    assert pose_error(moved(eye, turn), eye).translation == 0
    shift = motion.clone()
    shift[:3] = 0
    error = pose_error(moved(eye, shift), eye)
    assert_close(error.translation, float(shift.norm()), rtol=0, atol=1e-8)
    assert error.rotation < 1e-9


def test_no_pose_is_infinitely_wrong_and_nothing_matched_is_no_share() -> None:
    error = pose_error(None, eye)
    assert share_within([error.rotation, 1.0], 5.0) == 0.5
    assert math.isnan(share_within([1.0], 5.0, matches=0))


def of_opencv(rotation: np.ndarray, translation: np.ndarray) -> Tensor:
    pose = eye.clone()
    pose[:3, :3] = torch.from_numpy(rotation)
    pose[:3, 3] = torch.from_numpy(translation.ravel())
    return pose


@pytest.mark.shared
@pytest.mark.slow
def test_shares_of_right_poses_are_opencvs_within_two_points(shared_data: Path) -> None:
    """What benchmarks/pose_solvers.py measures by more detectors: poses of all pairs."""
    capture = open_capture(shared_data / "hololens")
    file = shared_data / "hololens" / "view_sets.json"
    extract = ours("deltas-small")
    found, theirs = [], []
    for anchor, sources in usable_view_sets(capture, file, None).view_sets:
        frames = [capture.frame(id) for id in (anchor, *sources)]
        size = fit_work_size(frames[0].image_size)
        views = anchor_views(frames, work_size=size)
        depth = torch.from_numpy(depth_at_image(frames[0], work_size=size))
        seen = [extract(load_image(frame, work_size=size), DetectionConfig()) for frame in frames]
        for number in range(1, len(frames)):
            one, two = matched_pixels(seen[0], seen[number])
            z = read_nearest(depth, one)
            points = unproject(views.select([0]), one[None, z > 0], z[None, z > 0])[0]
            for seed in range(2):
                order = torch.randperm(len(points), generator=torch.Generator().manual_seed(seed))
                known, pixels = points[order], two[z > 0][order]
                pose = absolute_pose(known, pixels, views.K[number], ConsensusConfig(seed=seed))
                true = views.cam_from_world[number]
                found.append(pose_error(None if pose is None else pose.model, true))
                theirs.append(pose_error(opencvs(known, pixels, views.K[number]), true))
    for limit, of in ((5.0, "rotation"), (0.05, "translation")):
        a, b = (share_within([getattr(e, of) for e in errors], limit) for errors in (found, theirs))
        assert abs(a - b) <= 0.02, f"{of}: {a} and OpenCV {b}"


@pytest.mark.shared
@pytest.mark.slow
def test_shares_of_right_relative_poses_are_opencvs_within_two_points(shared_data: Path) -> None:
    """Of ScanNet pairs that are far apart, by essential matrices; few poses are right by either.

    Five orders of the matches of three detectors: 120 poses, of which one is 0.8 points.
    """
    config = TableConfig(work_size=(480, 640))
    found, theirs = [], []
    for pair in read_pairs(shared_data / "scannet_pairs" / "pairs_with_gt.txt"):
        images, K = load_pair(pair, config)
        for _, extract, _ in load_extractors(["orb", "sift", "ours"]):
            one, two = matched_pixels(*(extract(image, config.detection) for image in images))
            for seed in range(5):
                order = torch.randperm(len(one), generator=torch.Generator().manual_seed(seed))
                first, second = one[order], two[order]
                search = replace(config.essential, seed=seed)
                pose = relative_pose_from_matches(first, second, K, search)
                true = pair.second_from_first
                found.append(pose_error(None if pose is None else pose.model, true))
                theirs.append(pose_error(opencvs_relative(first, second, K, search), true))
    for of, limit in product(("rotation", "direction"), (5.0, 10.0, 20.0)):
        a, b = (share_within([getattr(e, of) for e in errors], limit) for errors in (found, theirs))
        assert abs(a - b) <= 0.02, f"{of} within {limit}: {a} and OpenCV {b}"


def opencvs_relative(
    first: Tensor, second: Tensor, K: Tensor, config: ConsensusConfig
) -> Tensor | None:
    one, two = (
        cv2.undistortPoints(pixels.double().numpy()[:, None], k.double().numpy(), None)[:, 0]
        for pixels, k in zip((first, second), K, strict=True)
    )
    threshold = config.threshold / float(K[:, [0, 1], [0, 1]].mean())
    essential, inliers = cv2.findEssentialMat(
        one,
        two,
        np.eye(3),
        method=cv2.USAC_DEFAULT,
        prob=config.confidence,
        threshold=threshold,
        maxIters=config.most,
    )
    if essential is None or essential.shape != (3, 3):
        return None
    _, turn, shift, _ = cv2.recoverPose(essential, one, two, np.eye(3), mask=inliers)
    return of_opencv(turn, shift)


def opencvs(points: Tensor, pixels: Tensor, camera: Tensor) -> Tensor | None:
    known, seen, K = (part.double().numpy() for part in (points, pixels, camera))
    config = ConsensusConfig()
    ok, turn, shift, _ = cv2.solvePnPRansac(
        known,
        seen,
        K,
        None,
        iterationsCount=config.most,
        reprojectionError=config.threshold,
        confidence=config.confidence,
    )
    return of_opencv(cv2.Rodrigues(turn)[0], shift) if ok else None
