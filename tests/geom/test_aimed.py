"""Outliers, refinement and covariance of rays: in angles, as those of pixels."""

import math
from typing import Any

import pytest
import scipy.optimize
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close
from triangulation_cases import rays_to, surrounded

import deltas_geom as geom
from deltas_geom import Status
from deltas_geom.testing import rigid
from deltas_geom.testing.strategies import vectors

FOCAL = 1e6  # px, of images so narrow that a pixel is an angle


@st.composite
def sights(draw: st.DrawFn) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Four cameras, noisy rays to points on all sides, these, and weights of 0.5 to 1."""
    return *draw(surrounded(num_views=4)), 0.75 + draw(vectors(4, within=0.25, size=5))


def angles(poses: Tensor, rays: Tensor, points: Tensor) -> Tensor:
    there = rays_to(poses, points)
    return torch.atan2(torch.linalg.cross(rays, there).norm(dim=-1), (rays * there).sum(dim=-1))


def test_wrong_arguments_are_named() -> None:
    poses, rays, points, ones = (
        torch.eye(4).repeat(3, 1, 1),
        *(torch.ones(shape) for shape in ((2, 5, 3), (5, 3), (2, 5))),
    )
    for wrong in (
        lambda: geom.triangulate_robust_rays(poses, rays),
        lambda: geom.refine_rays(poses, rays, points),
        lambda: geom.ray_covariance(poses, points, ones),
    ):
        with pytest.raises(geom.ShapeError, match=r"V = [23]"):
            wrong()
    for threshold in (0.0, 1.6, math.nan):
        with pytest.raises(ValueError, match="threshold must be positive and below pi / 2"):
            geom.triangulate_robust_rays(poses[:2], rays, threshold=threshold)
    with pytest.raises(ValueError, match="scale must be positive"):
        geom.refine_rays(poses[:2], rays, points, scale=0.0)


@given(drawn=sights(), wrong=st.lists(st.integers(0, 3), min_size=5, max_size=5))
def test_wrong_rays_are_found_and_the_others_triangulated(
    drawn: tuple[Tensor, ...], wrong: list[int]
) -> None:
    poses, rays, _, weights = drawn
    mask = torch.tensor(wrong) != torch.arange(4)[:, None]
    # Straight away from where the right point is: no other view can agree.
    rays = torch.where(mask[..., None], rays, -rays)
    rays[:, 4] = torch.where(mask[:, 4, None], rays[:, 4], torch.nan)
    found = geom.triangulate_robust_rays(poses, rays, weights, covariance=True)
    wanted = geom.triangulate_rays(poses, rays, weights, mask, covariance=True)
    assert torch.equal(found.inliers, mask) and found.valid.all()
    for name, theirs in wanted._asdict().items():
        assert_close(getattr(found, name), theirs, rtol=0, atol=0)


@given(drawn=sights(), by=vectors(4, within=0.02, size=15))
def test_inliers_are_within_the_threshold_and_outliers_have_no_gradient(
    drawn: tuple[Tensor, ...], by: Tensor
) -> None:
    poses, rays, _, weights = drawn
    rays = (rays + by.reshape(4, 5, 3)).requires_grad_()
    found = geom.triangulate_robust_rays(poses, rays, weights, threshold=0.01)
    away = angles(poses, rays.detach(), found.points.detach())
    assert (away[found.inliers] < 0.01 + 1e-9).all()  # rad
    assert torch.equal(found.inliers.any(dim=0), found.valid)
    (gradient,) = torch.autograd.grad(found.points.sum(), rays)
    assert gradient.isfinite().all() and (gradient[~found.inliers] == 0).all()


def test_two_views_that_disagree_are_too_few() -> None:
    poses = torch.eye(4).repeat(2, 1, 1)
    poses[1, 0, 3] = -0.5
    rays = torch.tensor([[[0.0, 0, 1], [0.0, 0, 1]], [[-0.5, 0.2, 3], [-0.5, 0, 3]]])
    found = geom.triangulate_robust_rays(poses, rays)
    assert found.status.tolist() == [Status.TOO_FEW_VIEWS, Status.OK]
    none = geom.triangulate_robust_rays(poses, rays[:, :0])
    assert none.points.shape == (0, 3) and none.inliers.shape == (2, 0)
    many = geom.triangulate_robust_rays(poses, rays[:, 1:].expand(3, 2, 3000, 3))
    assert many.valid.shape == (3, 3000) and many.valid.all()


@given(drawn=sights(), by=vectors(5, within=0.05))
def test_refined_points_have_the_least_tangents(drawn: tuple[Tensor, ...], by: Tensor) -> None:
    poses, rays, points, weights = drawn
    found = geom.refine_rays(poses, rays, points + by, weights, steps=8)
    assert found.valid.all()
    least = found.points.detach().requires_grad_()
    there = rays_to(poses, least)
    across = torch.linalg.cross(rays, there).square().sum(dim=-1)
    tangent = across / (rays * there).sum(dim=-1).square()
    (slope,) = torch.autograd.grad((weights.square() * tangent).sum(), least)
    assert (slope.abs() < 1e-9).all()  # 1/m
    away = (weights * angles(poses, rays, found.points)).square().sum(dim=0)
    assert_close(found.residual, (away / weights.square().sum(dim=0)).sqrt(), rtol=1e-9, atol=1e-12)


def test_a_robust_loss_gives_in_less_to_a_wrong_ray() -> None:
    poses = torch.eye(4).double().repeat(4, 1, 1)
    poses[:, 0, 3] = -0.4 * torch.arange(4)
    points = torch.tensor([[0.3, 0.1, 3.0]]).double()
    rays = rays_to(poses, points)
    rays[2, 0, 1] += 0.3
    start = geom.triangulate_rays(poses, rays).points
    plain = geom.refine_rays(poses, rays, start, steps=20).points
    robust = geom.refine_rays(poses, rays, start, steps=20, loss="cauchy", scale=3e-3).points
    assert (robust - points).norm() < 0.05 * (plain - points).norm()


@given(drawn=sights(), of_poses=st.booleans())
def test_the_covariance_is_that_of_triangulation_and_moves_with_poses(
    drawn: tuple[Tensor, ...], of_poses: bool
) -> None:
    poses, rays, _, weights = drawn
    found = geom.triangulate_rays(poses, rays, weights, covariance=True)
    ours = geom.ray_covariance(poses, found.points, weights)
    assert found.covariance is not None
    size = float(ours.abs().max())
    assert_close(ours, found.covariance, rtol=0, atol=1e-9 * size)
    # All cameras displaced alike displace the point as much; independently, by less.
    spread = torch.diag(torch.tensor([1e-4, 1e-4, 1e-4, 0, 0, 0])).double().expand(4, 6, 6)
    more = geom.ray_covariance(poses, found.points, weights, pose_covariance=spread) - ours
    assert (torch.linalg.eigvalsh(more) > 0).all()


def test_a_pixel_of_a_narrow_image_is_an_angle() -> None:
    generator = torch.Generator().manual_seed(0)
    point = torch.tensor([0.0, 0, 4]).double()
    centers = torch.randn(4, 3, generator=generator, dtype=torch.float64)
    # Each camera looks at the point.
    ahead = torch.nn.functional.normalize(point - centers, dim=-1)
    side = torch.nn.functional.normalize(
        torch.linalg.cross(ahead, torch.eye(3)[0].double().expand(4, 3)), dim=-1
    )
    turn = torch.stack([side, torch.linalg.cross(ahead, side), ahead], dim=-2)
    poses = torch.eye(4).double().repeat(4, 1, 1)
    poses[:, :3, :3], poses[:, :3, 3:] = turn, -turn @ centers[..., None]
    K = torch.diag(torch.tensor([FOCAL, FOCAL, 1])).double()
    pixels = torch.randn(4, 6, 2, generator=generator, dtype=torch.float64)
    pixels[1, :3] += 300
    rays = geom.to_homogeneous(pixels / FOCAL)
    proj, start = K @ poses[:, :3], point.expand(6, 3) + 1e-6
    robust = geom.triangulate_robust(proj, pixels, threshold=20.0)
    ours = geom.triangulate_robust_rays(poses, rays, threshold=20 / FOCAL)
    assert torch.equal(ours.inliers, robust.inliers) and not ours.inliers[1, :3].any()
    assert_close(ours.points, robust.points, rtol=0, atol=1e-9)  # m
    refined: Any = geom.refine_points(proj, pixels, start, steps=3)
    by_rays = geom.refine_rays(poses, rays, start, steps=3)
    assert_close(by_rays.points, refined.points, rtol=0, atol=1e-9)
    assert_close(by_rays.residual * FOCAL, refined.residual, rtol=1e-6, atol=0)
    ones = torch.ones(4, 6).double()
    assert_close(
        geom.ray_covariance(poses, start, ones * FOCAL),
        geom.point_covariance(proj, start, ones),
        rtol=1e-6,
        atol=1e-18,
    )


@pytest.mark.parametrize("gradient", ["unrolled", "implicit"])
def test_gradients_of_refined_points_are_those_of_the_optimum(gradient: Any) -> None:
    generator = torch.Generator().manual_seed(0)
    poses = torch.eye(4).double().repeat(3, 1, 1)
    poses[1, 0, 3], poses[2, 1, 3] = -0.5, -0.4
    rays = rays_to(poses, torch.tensor([[0.3, 0.1, 3.0]]).double())
    rays = rays + 1e-2 * torch.randn(rays.shape, generator=generator, dtype=torch.float64)
    inputs = (poses.requires_grad_(), rays.requires_grad_())

    def solve(poses: Tensor, rays: Tensor) -> Tensor:
        start = geom.triangulate_rays(poses, rays).points.detach()
        return geom.refine_rays(poses, rays, start, steps=12, gradient=gradient).points

    assert torch.autograd.gradcheck(solve, inputs, eps=1e-6, atol=1e-5)


def test_scipy_finds_the_same_points() -> None:
    generator = torch.Generator().manual_seed(3)
    poses = rigid(torch.zeros(4, 3), torch.randn(4, 3, generator=generator)).double()
    point = torch.tensor([[0.5, 0.2, 6.0]]).double()
    rays = rays_to(poses, point)
    rays = rays + 0.02 * torch.randn(rays.shape, generator=generator, dtype=torch.float64)
    ours = geom.refine_rays(poses, rays, point, steps=20).points[0]

    def tangents(point):
        away = angles(poses, rays, torch.from_numpy(point)[None])[:, 0]
        return away.tan().numpy()

    best = scipy.optimize.least_squares(tangents, point[0].numpy(), xtol=1e-14, ftol=1e-14)
    assert_close(ours, torch.from_numpy(best.x), rtol=0, atol=1e-5)  # m


def test_what_is_not_used_may_hold_anything_and_what_is_used_fails() -> None:
    poses = torch.eye(4).double().repeat(4, 1, 1)
    poses[:, 0, 3] = -0.4 * torch.arange(4)
    points = torch.tensor([[0.3, 0.1, 3.0], [0.1, 0.2, 2.0]]).double()
    rays = rays_to(poses, points)
    bad = poses.clone()
    bad[3], rays[3] = torch.nan, torch.nan
    inputs = (bad.requires_grad_(), rays.requires_grad_())
    mask = torch.ones(4, 2, dtype=torch.bool)
    mask[3] = False
    refined = geom.refine_rays(*inputs, points + 0.01, mask=mask, steps=5)
    assert refined.valid.all()
    assert_close(refined.points, points, rtol=0, atol=1e-9)
    for gradient in torch.autograd.grad(refined.points.sum(), inputs):
        assert gradient.isfinite().all() and (gradient[3] == 0).all()
    assert not geom.refine_rays(*inputs, points).valid.any()
    ones = torch.ones(4, 2).double()
    assert (geom.ray_covariance(bad, points, ones) == 0).all()
    wanted = geom.ray_covariance(poses[:3], points, ones[:3])
    assert_close(geom.ray_covariance(bad, points, ones, mask=mask), wanted, rtol=1e-9, atol=0)
