"""Triangulation of bearing rays of any camera model."""

import math
from collections.abc import Callable

import pytest
import torch
from hypothesis import given
from kornia.geometry.calibration import distort_points, undistort_points
from torch import Tensor
from torch.testing import assert_close
from triangulation_cases import rays_to, surrounded

from deltas_geom import (
    Triangulation,
    camera_centers,
    pixel_rays,
    triangulate,
    triangulate_inverse_depth_weighted,
    triangulate_midpoint,
    triangulate_rays,
)
from deltas_geom.testing import (
    PosedScene,
    default_intrinsics,
    forward_motion,
    right_angle,
    rigid,
)
from deltas_geom.testing.strategies import posed_scenes, vectors


def rays_of(scene: PosedScene) -> Tensor:
    return pixel_rays(scene.views.K, scene.pixels)


def noisy(rays: Tensor, noise: Tensor) -> Tensor:
    return rays / rays.norm(dim=-1, keepdim=True) + noise


@given(scene=posed_scenes(num_views=3), lengths=vectors(3, within=0.9, size=4))
def test_rays_of_pinhole_cameras_give_what_their_pixels_give(
    scene: PosedScene, lengths: Tensor
) -> None:
    rays = rays_of(scene) * (1 + lengths)[..., None]
    by_rays = triangulate_rays(scene.views.cam_from_world, rays)
    by_pixels = triangulate(scene.views.proj, scene.pixels)
    assert by_rays.valid.all()
    assert_close(by_rays.points, by_pixels.points, rtol=0, atol=1e-9)  # m
    assert_close(by_rays.parallax, by_pixels.parallax, rtol=0, atol=1e-9)  # rad
    distance = (by_pixels.points - camera_centers(scene.views.cam_from_world)[:, None]).norm(dim=-1)
    assert_close(by_rays.depth, distance, rtol=0, atol=1e-9)  # m
    assert (by_rays.residual < 1e-9).all()  # rad


@pytest.mark.parametrize(
    "solve", [triangulate_rays, triangulate_midpoint, triangulate_inverse_depth_weighted]
)
@given(drawn=surrounded(noise=0.0), turn=vectors(1, within=3.0))
def test_rays_may_point_anywhere(
    solve: Callable[..., Triangulation], drawn: tuple[Tensor, ...], turn: Tensor
) -> None:
    cam_from_world, rays, points = drawn
    result = solve(cam_from_world, rays)
    assert result.valid.all()
    assert_close(result.points, points, rtol=0, atol=1e-9)  # m
    assert (result.residual < 1e-9).all()  # rad
    # How a camera is turned does not count, as a pixel's place in its image would.
    off = noisy(rays, 2e-3 * torch.ones(3).double())
    axes = rigid(turn, torch.zeros(1, 3).double())[0]
    other = solve(axes @ cam_from_world, off @ axes[:3, :3].mT)
    assert_close(other.points, solve(cam_from_world, off).points, rtol=0, atol=1e-9)  # m


def test_a_fisheye_sees_behind_its_image_plane() -> None:
    # Equidistant, r = f theta, 230 degrees across: from pixel to ray in two lines.
    focal, center = 100.0, torch.tensor([320.0, 320.0]).double()
    pose = rigid(
        torch.tensor([[0.0, 0, 0], [0.1, -0.2, 0.05]]).double(),
        torch.tensor([[0.0, 0, 0], [-0.4, 0.1, 0]]).double(),
    )
    points = torch.tensor([[2.0, 0.3, -0.5], [-1.5, 0.4, 0.0], [0.2, 0.1, 3.0]]).double()
    local = rays_to(pose, points)
    theta = torch.atan2(local[..., :2].norm(dim=-1), local[..., 2])
    assert (theta[:, 0] > math.pi / 2).all()
    side = local[..., :2] / local[..., :2].norm(dim=-1, keepdim=True)
    pixels = center + focal * theta[..., None] * side

    offset = pixels - center
    angle = offset.norm(dim=-1, keepdim=True) / focal
    rays = torch.cat([angle.sin() * offset / (focal * angle), angle.cos()], dim=-1)
    result = triangulate_rays(pose, rays)
    assert result.valid.all()
    assert_close(result.points, points, rtol=0, atol=1e-9)  # m


def test_kornia_undistorts_in_front() -> None:
    scene = forward_motion()
    distortion = torch.tensor([-0.2, 0.05, 1e-3, -5e-4]).double().expand(2, 4)
    seen = distort_points(scene.pixels, scene.views.K, distortion)
    assert (seen - scene.pixels).norm(dim=-1).max() > 2  # px
    straight = undistort_points(seen, scene.views.K, distortion, num_iters=50)
    result = triangulate_rays(scene.views.cam_from_world, pixel_rays(scene.views.K, straight))
    assert_close(result.points, scene.points, rtol=0, atol=1e-6)  # m


def test_the_residual_is_an_angle() -> None:
    scene = right_angle()
    rays = rays_of(scene).repeat(1, 2, 1)
    result = triangulate_rays(scene.views.cam_from_world, rays)
    # One ray out of the plane of the two by 0.01 rad: each gives way by half.
    rays[0, 1] = torch.tensor([0.0, math.sin(0.01), math.cos(0.01)])
    result = triangulate_rays(scene.views.cam_from_world, rays)
    assert result.residual[0] < 1e-12
    assert_close(result.residual[1].item(), 0.005, rtol=1e-3, atol=0)


def test_a_ray_in_the_image_plane_pulls_as_hard_as_any() -> None:
    # A pixel's weight grows with 1 / cos^2 towards the plane; a ray's does not.
    pose = default_intrinsics().new_zeros(3, 4, 4)
    pose[:] = torch.eye(4)
    pose[1, 0, 3], pose[2, 1, 3] = -0.5, -0.5
    points = torch.tensor([[3.0, 0.2, 0.0]]).double()
    turned = rigid(torch.tensor([0.0, 1.5, 0.0]).double(), torch.zeros(3).double())
    rays = noisy(rays_to(pose, points), 1e-3 * torch.eye(3).double()[:, None])
    one = triangulate_rays(pose, rays)
    other = triangulate_rays(turned @ pose, rays @ turned[:3, :3].mT)
    assert one.valid.all()
    assert_close(other.points, one.points, rtol=0, atol=1e-10)  # m
