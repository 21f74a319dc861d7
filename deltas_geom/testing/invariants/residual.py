"""Invariants of what is measured at given points: residual and parallax."""

import torch
from torch import Tensor

from deltas_geom.cameras.poses import camera_centers
from deltas_geom.cameras.projection import project
from deltas_geom.testing.agreement import PIXEL_TOLERANCE, assert_near
from deltas_geom.testing.changes import ELSEWHERE, World
from deltas_geom.testing.invariants.triangulation import weights_for
from deltas_geom.testing.registry import invariant
from deltas_geom.testing.scenes import PosedScene
from deltas_geom.testing.target import Target


@invariant("residual")
def an_exact_point_has_no_residual(target: Target, scene: PosedScene) -> None:
    """The residual of a point at its own pixels is 0."""
    exact = scene._replace(pixels=project(scene.views, scene.points).pixels)
    found = _residual(target, exact, weights_for(target, scene, None))
    assert_near(found, torch.zeros_like(found), PIXEL_TOLERANCE, "px")


@invariant("residual")
def the_residual_is_the_rms_distance_in_pixels(
    target: Target, scene: PosedScene, *, weights: Tensor | None = None
) -> None:
    """A residual is the root of the mean squared distance in px, of squared weights if any."""
    weights = weights_for(target, scene, weights)
    exact = project(scene.views, scene.points).pixels
    views, points = exact.shape[:2]
    # 3-4-5 triangles: view v is (v + 1) times 5 px off.
    step = exact.new_tensor([3.0, -4.0]) * torch.arange(1, views + 1).to(exact)[:, None, None]
    found = _residual(target, scene._replace(pixels=exact + step), weights)
    distance = step.norm(dim=-1).expand(views, points)
    squared = torch.ones_like(distance) if weights is None else weights.square()
    wanted = ((squared * distance.square()).sum(dim=0) / squared.sum(dim=0)).sqrt()
    assert_near(found, wanted, PIXEL_TOLERANCE, "px")


@invariant("residual")
def the_residual_does_not_know_the_worlds_frame(
    target: Target, scene: PosedScene, *, world: World = ELSEWHERE
) -> None:
    """The residual stays when cameras and points are moved, turned and scaled together."""
    weights = weights_for(target, scene, None)
    moved = PosedScene(world.views(scene.views), world.points(scene.points), scene.pixels + 2)
    still = scene._replace(pixels=scene.pixels + 2)
    found, wanted = (_residual(target, seen, weights) for seen in (moved, still))
    assert_near(found, wanted, PIXEL_TOLERANCE, "px")


@invariant("parallax")
def the_parallax_is_the_largest_angle_between_rays(target: Target, scene: PosedScene) -> None:
    """A point's parallax is the largest angle, in rad, at which two of its rays meet."""
    # No outer camera of a row is first; and from near by cameras stand to both sides.
    scene = scene._replace(views=scene.views.select(list(range(-1, scene.views.num_views - 1))))
    centers = camera_centers(scene.views.cam_from_world)
    for share in (1.0, 0.02):
        near = scene._replace(points=torch.lerp(centers.mean(dim=0), scene.points, share))
        rays = near.points - centers[:, None]
        across = torch.linalg.cross(rays[:, None], rays[None]).norm(dim=-1)
        angle = torch.atan2(across, (rays[:, None] * rays[None]).sum(dim=-1))
        assert_near(_parallax(target, near), angle.amax(dim=(0, 1)), 1e-8, "rad")


@invariant("parallax")
def the_parallax_does_not_know_the_worlds_frame(
    target: Target, scene: PosedScene, *, world: World = ELSEWHERE
) -> None:
    """The parallax stays when cameras and points are moved, turned and scaled together."""
    moved = PosedScene(world.views(scene.views), world.points(scene.points), scene.pixels)
    assert_near(_parallax(target, moved), _parallax(target, scene), 1e-8, "rad")


def _residual(target: Target, scene: PosedScene, weights: Tensor | None) -> Tensor:
    assert target.residual is not None
    return target.residual(scene.views.proj, scene.pixels, scene.points, weights)


def _parallax(target: Target, scene: PosedScene) -> Tensor:
    assert target.parallax is not None
    return target.parallax(scene.views.proj, scene.points)
