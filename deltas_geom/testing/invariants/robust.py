"""Invariants of triangulation that rejects wrong views."""

import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import to_homogeneous
from deltas_geom.cameras.poses import invert_pose
from deltas_geom.cameras.projection import project
from deltas_geom.testing.agreement import POINT_TOLERANCE, assert_near
from deltas_geom.testing.changes import ELSEWHERE, World
from deltas_geom.testing.invariants.triangulation import weights_for
from deltas_geom.testing.registry import invariant
from deltas_geom.testing.scenes import PosedScene
from deltas_geom.testing.target import Target

_THRESHOLD = 4.0  # px


@invariant("robust")
def where_no_view_is_wrong_all_are_inliers(target: Target, scene: PosedScene) -> None:
    """The pixels of a point give the point, and every view is an inlier."""
    exact = project(scene.views, scene.points).pixels
    _assert_found(target, scene._replace(pixels=exact), torch.ones_like(exact[..., 0]).bool())


@invariant("robust", "many views")
def a_wrong_view_does_not_move_a_robust_point(
    target: Target, scene: PosedScene, *, view: int = -1, spoil: float = 200.0
) -> None:
    """One view far beside its epipolar lines (``spoil`` px) is found, and moves nothing."""
    pixels = project(scene.views, scene.points).pixels
    right = torch.ones_like(pixels[..., 0]).bool()
    # The cameras of scenes stand beside each other: lines are level, more or less.
    pixels[view, :, 1] += spoil
    right[view] = False
    _assert_found(target, scene._replace(pixels=pixels), right)


@invariant("robust", "weights", "many views")
def a_view_of_weight_0_does_not_move_a_robust_point(
    target: Target, scene: PosedScene, *, view: int = -1, spoil: float = 2.0
) -> None:
    """A view of weight 0 moves nothing, also where it is off by less than the threshold."""
    pixels = project(scene.views, scene.points).pixels
    pixels[view, :, 1] += spoil
    weights = weights_for(target, scene, None)
    assert weights is not None and target.robust is not None
    weights[view] = 0
    points, _ = target.robust(scene.views.proj, pixels, weights, _THRESHOLD)
    assert_near(points, scene.points, POINT_TOLERANCE, "m", "point")


@invariant("robust")
def inliers_are_within_the_threshold(
    target: Target, scene: PosedScene, *, spoil: float = 9.0
) -> None:
    """Inliers see the point within the threshold, whatever the noise, and by half of it all do."""
    for limit in (_THRESHOLD, 4 * _THRESHOLD):
        for shift in (0.0, 0.5 * spoil, spoil, -2 * spoil):
            pixels = scene.pixels.clone()
            pixels[0, :, 1] += shift
            points, inliers = _robust(target, scene._replace(pixels=pixels), limit)
            seen = to_homogeneous(points.to(pixels)) @ scene.views.proj.mT
            distance = (seen[..., :2] / seen[..., 2:] - pixels).norm(dim=-1)
            beyond = torch.where(inliers, distance - limit, 0.0).clamp(min=0)
            assert_near(beyond, torch.zeros_like(beyond), 1e-6, f"px (beyond {limit} px)")
            lost = ~inliers & inliers.any(dim=0) & (distance < limit / 2)
            if bool(lost.any()):
                view, point = lost.nonzero()[0].tolist()
                off = float(distance[view, point])
                raise AssertionError(f"view {view} is no inlier of point {point}, at {off} px")


@invariant("robust")
def robust_points_move_with_the_world(
    target: Target, scene: PosedScene, *, world: World = ELSEWHERE
) -> None:
    """Where cameras are moved, turned and scaled, robust points go with them."""
    moved, _ = _robust(target, scene._replace(views=world.views(scene.views)))
    back = World(invert_pose(world.new_from_world), 1.0).points(moved / world.scale)
    assert_near(back, _robust(target, scene)[0], POINT_TOLERANCE, "m", "point")


def _robust(target: Target, scene: PosedScene, limit: float = _THRESHOLD) -> tuple[Tensor, Tensor]:
    assert target.robust is not None
    weights = weights_for(target, scene, None)
    return target.robust(scene.views.proj, scene.pixels, weights, limit)


def _assert_found(target: Target, scene: PosedScene, right: Tensor) -> None:
    points, inliers = _robust(target, scene)
    wrong = inliers != right
    if bool(wrong.any()):
        view, point = wrong.nonzero()[0].tolist()
        is_one = "an inlier" if bool(inliers[view, point]) else "no inlier"
        raise AssertionError(f"view {view} is {is_one} of point {point}")
    assert_near(points, scene.points, POINT_TOLERANCE, "m", "point")
