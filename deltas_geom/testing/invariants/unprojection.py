"""Invariants of pixels turned into rays, and with a depth into points."""

import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import to_homogeneous
from deltas_geom.cameras.projection import project
from deltas_geom.cameras.views import PosedViews
from deltas_geom.testing.agreement import (
    PIXEL_TOLERANCE,
    POINT_TOLERANCE,
    assert_finite,
    assert_near,
)
from deltas_geom.testing.changes import ELSEWHERE, World, cut, transformed
from deltas_geom.testing.registry import invariant
from deltas_geom.testing.scenes import PosedScene
from deltas_geom.testing.target import Target


@invariant("unproject")
def a_pixel_with_its_depth_is_its_point(target: Target, scene: PosedScene) -> None:
    """Pixels of a point, with its depth along each camera's z, give the point in every view."""
    seen = project(scene.views, scene.points)
    found = _points(target, scene.views, seen.pixels, seen.depth)
    assert_near(found, scene.points.expand_as(found), POINT_TOLERANCE, "m", "view point")


@invariant("unproject")
def unprojected_points_move_with_the_world(
    target: Target, scene: PosedScene, *, world: World = ELSEWHERE
) -> None:
    """Where cameras and depths are moved, turned and scaled, the points go with them."""
    depth = project(scene.views, scene.points).depth
    moved = _points(target, world.views(scene.views), scene.pixels, world.scale * depth)
    wanted = world.points(_points(target, scene.views, scene.pixels, depth))
    assert_near(moved, wanted, POINT_TOLERANCE, "m", "view point")


@invariant("unproject")
def unprojected_points_do_not_know_of_a_crop_and_a_resize(
    target: Target, scene: PosedScene
) -> None:
    """Points stay when each image is cropped elsewhere and resized."""
    depth = project(scene.views, scene.points).depth
    change = cut(scene.views, new_size=(240, 160))
    views = scene.views._replace(K=change @ scene.views.K)
    found = _points(target, views, transformed(change, scene.pixels), depth)
    assert_near(
        found, _points(target, scene.views, scene.pixels, depth), POINT_TOLERANCE, "m", "view point"
    )


@invariant("rays")
def a_ray_is_seen_at_its_pixel(target: Target, scene: PosedScene) -> None:
    """K times the ray of a pixel is the pixel with a last coordinate of 1, skew included."""
    assert target.rays is not None
    rays = target.rays(scene.views.K, scene.pixels)
    found = rays @ scene.views.K.to(rays).mT
    assert_near(found, to_homogeneous(scene.pixels), PIXEL_TOLERANCE, "px", "view point")


@invariant("rays")
def rays_do_not_know_of_a_crop_and_a_resize(target: Target, scene: PosedScene) -> None:
    """Rays stay when each image is cropped elsewhere and resized."""
    assert target.rays is not None
    change = cut(scene.views, new_size=(240, 160))
    found = target.rays(change @ scene.views.K, transformed(change, scene.pixels))
    assert_near(found, target.rays(scene.views.K, scene.pixels), 1e-8, "(slope of a ray)")


@invariant("rays", scenes="named")
def rays_are_finite(target: Target, scene: PosedScene) -> None:
    """Rays of finite pixels are finite, however far from the image."""
    assert target.rays is not None
    far = torch.tensor([[1e15, -1e15], [1e-15, 0.0]]).to(scene.pixels)
    pixels = torch.cat([scene.pixels, far.expand(scene.views.num_views, 2, 2)], dim=1)
    assert_finite(target.rays(scene.views.K, pixels), "rays")


def _points(target: Target, views: PosedViews, pixels: Tensor, depth: Tensor) -> Tensor:
    assert target.unproject is not None
    return target.unproject(views.K, views.cam_from_world, pixels, depth)
