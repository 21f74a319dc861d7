"""Invariants of projection."""

import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import to_homogeneous
from deltas_geom.cameras.poses import camera_centers
from deltas_geom.cameras.views import PosedViews
from deltas_geom.testing.agreement import (
    EXTREMES,
    PIXEL_TOLERANCE,
    assert_finite,
    assert_gradients,
    assert_near,
    gradients,
)
from deltas_geom.testing.changes import ELSEWHERE, World, cut, transformed
from deltas_geom.testing.registry import invariant
from deltas_geom.testing.scenes import PosedScene
from deltas_geom.testing.target import Target


@invariant("project")
def pixels_are_those_of_the_camera_equations(
    target: Target, scene: PosedScene, *, tolerance: float = PIXEL_TOLERANCE
) -> None:
    """A pixel is K [R | t] X divided by its last coordinate, skew included."""
    homogeneous = to_homogeneous(scene.points) @ scene.views.proj.mT
    wanted = homogeneous[..., :2] / homogeneous[..., 2:]
    assert_near(_pixels(target, scene.views, scene.points), wanted, tolerance, "px", "view point")


@invariant("project")
def pixels_do_not_know_the_worlds_frame(
    target: Target,
    scene: PosedScene,
    *,
    world: World = ELSEWHERE,
    tolerance: float = PIXEL_TOLERANCE,
) -> None:
    """Pixels stay when cameras and points are moved, turned and scaled together."""
    moved = _pixels(target, world.views(scene.views), world.points(scene.points))
    assert_near(moved, _pixels(target, scene.views, scene.points), tolerance, "px", "view point")


@invariant("project")
def pixels_follow_a_crop_and_a_resize(
    target: Target, scene: PosedScene, *, tolerance: float = PIXEL_TOLERANCE
) -> None:
    """A camera of the cropped and resized image sees points where their pixels went."""
    change = cut(scene.views, new_size=(240, 160))
    seen = _pixels(target, scene.views._replace(K=change @ scene.views.K), scene.points)
    wanted = transformed(change, _pixels(target, scene.views, scene.points))
    assert_near(seen, wanted, tolerance, "px", "view point")


@invariant("project", "autograd")
def gradients_of_pixels_are_finite_differences(target: Target, scene: PosedScene) -> None:
    """The gradient by points, K and poses is that of finite differences, and finite everywhere."""
    views = scene.views

    def see(points: Tensor, K: Tensor, pose: Tensor) -> Tensor:
        return _pixels(target, views._replace(K=K, cam_from_world=pose), points)

    inputs = [scene.points, views.K, views.cam_from_world]
    names = ("points", "K", "cam_from_world")
    assert_gradients(see, inputs, names, "px")
    inputs[0] = torch.cat([scene.points, camera_centers(views.cam_from_world)])

    def loss(*inputs: Tensor) -> Tensor:
        pixels = see(*inputs)
        return pixels[pixels.isfinite()].sum()

    for name, gradient in zip(names, gradients(loss, inputs), strict=True):
        assert_finite(gradient, f"in a camera's centre the gradient by {name}")


@invariant("project", scenes="named")
def pixels_are_finite(target: Target, scene: PosedScene, *, points: Tensor | None = None) -> None:
    """Pixels of finite points are finite, even behind a camera or in its very centre."""
    centers = camera_centers(scene.views.cam_from_world)
    points = EXTREMES.to(centers) if points is None else points
    points = torch.cat([scene.points, centers, points])
    assert_finite(_pixels(target, scene.views, points[points.isfinite().all(dim=-1)]), "pixels")


def _pixels(target: Target, views: PosedViews, points: Tensor) -> Tensor:
    assert target.project is not None
    return target.project(views.K, views.cam_from_world, points)
