"""Optimal triangulation of two views, against refinement, OpenCV and by its invariants."""

import math

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import (
    PosedViews,
    ShapeError,
    Status,
    camera_centers,
    fundamental_between,
    project,
    refine_points,
    reprojection_residual,
    to_homogeneous,
    triangulate,
    triangulate_two_view,
)
from deltas_geom.testing import (
    PosedScene,
    default_intrinsics,
    forward_motion,
    on_baseline,
    right_angle,
    rigid,
    scene_from,
)
from deltas_geom.testing.strategies import posed_scenes, vectors


@st.composite
def noisy(draw: st.DrawFn, noise: float = 1.0) -> PosedScene:
    """Two views of four points, and pixels that are off by up to ``noise`` px."""
    scene = draw(posed_scenes())
    offset = draw(vectors(8, within=noise, size=2)).reshape(2, 4, 2)
    return scene._replace(pixels=scene.pixels + offset)


def turned(angle: float, *, count: int = 500, noise: float = 1.0) -> PosedScene:
    """Two cameras ``angle`` degrees apart, 4 m from a cloud of 1 m; Gaussian noise in px."""
    generator = torch.Generator().manual_seed(0)
    half = math.radians(angle) / 2
    turns = torch.tensor([[0, half, 0], [0, -half, 0]], dtype=torch.float64)
    pose = rigid(turns, torch.tensor([[0.0, 0, 4], [0, 0, 4]]).double())
    views = PosedViews(default_intrinsics().expand(2, 3, 3), pose)
    cloud = torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5
    scene = scene_from(views, cloud)
    off = torch.randn(scene.pixels.shape, generator=generator, dtype=torch.float64)
    return scene._replace(pixels=scene.pixels + noise * off)


def epipolar_error(views: PosedViews, pixels: Tensor) -> Tensor:
    """Sampson's distance of pairs, px: to first order how far they would have to move."""
    fundamental = fundamental_between(views)
    first, second = to_homogeneous(pixels).unbind(dim=-3)
    lines, back = first @ fundamental.mT, second @ fundamental
    squared = lines[..., :2].square().sum(dim=-1) + back[..., :2].square().sum(dim=-1)
    return (lines * second).sum(dim=-1) / squared.sqrt()


def test_wrong_arguments_are_named() -> None:
    proj, pixels = torch.zeros(2, 3, 4), torch.zeros(2, 5, 2)
    with pytest.raises(ShapeError, match=r"pixels must have shape \(\*B, 2, N, 2\), got \(3, 5"):
        triangulate_two_view(proj, torch.zeros(3, 5, 2))
    with pytest.raises(ShapeError, match=r"proj must have shape \(\*B, 2, 3, 4\), got \(3, 3"):
        triangulate_two_view(torch.zeros(3, 3, 4), pixels)
    with pytest.raises(ShapeError, match="mask has N = 4 but pixels has N = 5"):
        triangulate_two_view(proj, pixels, torch.ones(2, 4, dtype=torch.bool))


@given(scene=posed_scenes())
def test_pixels_without_noise_stay_and_give_the_point(scene: PosedScene) -> None:
    result = triangulate_two_view(scene.views.proj, scene.pixels)
    assert result.valid.all()
    assert_close(result.pixels, scene.pixels, rtol=0, atol=1e-10)  # px
    assert_close(result.points, scene.points, rtol=0, atol=1e-9)  # m
    assert_close(result.depth, project(scene.views, scene.points).depth, rtol=0, atol=1e-9)
    assert (result.residual < 1e-10).all()  # px


@given(scene=noisy())
def test_corrected_pixels_meet_on_the_point_that_they_show(scene: PosedScene) -> None:
    result = triangulate_two_view(scene.views.proj, scene.pixels)
    assert result.valid.all()
    assert (epipolar_error(scene.views, result.pixels).abs() < 1e-9).all()  # px
    shown = project(scene.views, result.points)
    assert_close(shown.pixels, result.pixels, rtol=0, atol=1e-9)  # px
    assert_close(shown.depth, result.depth, rtol=0, atol=1e-12)  # m
    residual = reprojection_residual(
        scene.views.proj, result.points, scene.pixels, torch.ones_like(result.depth)
    )
    assert_close(result.residual, residual, rtol=0, atol=1e-9)  # px
    assert_close(
        result.parallax, triangulate(scene.views.proj, result.pixels).parallax, rtol=0, atol=1e-9
    )


@given(scene=noisy(noise=5.0))
def test_no_point_of_dlt_is_better(scene: PosedScene) -> None:
    result = triangulate_two_view(scene.views.proj, scene.pixels)
    by_dlt = triangulate(scene.views.proj, scene.pixels)
    both = result.valid & by_dlt.valid
    assert (result.residual <= by_dlt.residual + 1e-9)[both].all()  # px, rounding


@pytest.mark.parametrize("angle", [1, 3, 10, 30, 90])
def test_the_cost_is_that_of_many_gauss_newton_steps(angle: float) -> None:
    scene = turned(angle)
    result = triangulate_two_view(scene.views.proj, scene.pixels)
    start = triangulate(scene.views.proj, scene.pixels)
    optimum = refine_points(scene.views.proj, scene.pixels, start.points, steps=20)
    assert result.valid.all() and optimum.valid.all()
    # Where the cost itself is next to nothing only its rounding can differ.
    assert_close(result.residual**2, optimum.residual**2, rtol=1e-6, atol=1e-10)  # px^2
    # DLT is worse by more than the tolerance, or this would test nothing.
    worse = (start.residual**2 / optimum.residual**2 - 1).max()
    assert worse > 3e-6


@given(scene=noisy())
def test_cameras_that_differ_come_close_to_the_optimum(scene: PosedScene) -> None:
    result = triangulate_two_view(scene.views.proj, scene.pixels)
    optimum = refine_points(scene.views.proj, scene.pixels, result.points, steps=20)
    assert_close(result.residual**2, optimum.residual**2, rtol=1e-5, atol=1e-10)  # px^2


@pytest.mark.parametrize(("noise", "tolerance"), [(1, 1e-6), (10, 1e-3)])
@pytest.mark.parametrize("angle", [3, 30, 90])
def test_opencv_corrects_matches_as_we_do(angle: float, noise: float, tolerance: float) -> None:
    scene = turned(angle, noise=noise)
    result = triangulate_two_view(scene.views.proj, scene.pixels)
    # OpenCV: points2^T F points1 = 0, and points in one row of two channels.
    fundamental = fundamental_between(scene.views).numpy()
    first, second = (pixels.numpy()[None] for pixels in scene.pixels)
    corrected = torch.from_numpy(np.concatenate(cv2.correctMatches(fundamental, first, second)))
    finite = corrected.isfinite().all(dim=-1).all(dim=0) & result.valid
    assert finite.double().mean() > 0.8
    assert_close(result.pixels[:, finite], corrected[:, finite], rtol=0, atol=tolerance)  # px
    # Where we differ, the roots of OpenCV's polynomial have lost digits: its cost is higher.
    theirs = (corrected - scene.pixels).square().sum(dim=-1).sum(dim=0)
    assert (2 * result.residual**2 <= theirs + 1e-10)[finite].all()  # px^2


def test_there_is_no_better_pair_of_epipolar_lines() -> None:
    # Hartley and Sturm: the cost of a pair of lines is a function of the line's angle alone.
    scene = forward_motion()
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(2, 200, 2, generator=generator, dtype=torch.float64)
    pixels = scene.pixels[:, torch.arange(200) % 3] + 3 * noise
    result = triangulate_two_view(scene.views.proj, pixels)
    epipole = torch.tensor([320.0, 240.0]).double()  # of both, and lines have the same angle
    angle = torch.linspace(0, math.pi, 20001, dtype=torch.float64)
    normal = torch.stack([angle.cos(), angle.sin()], dim=-1)
    cost = ((pixels - epipole) @ normal.mT).square().sum(dim=0).amin(dim=-1)
    valid = result.valid
    assert valid.double().mean() > 0.9
    assert_close(2 * result.residual[valid] ** 2, cost[valid], rtol=1e-3, atol=1e-3)  # px^2


def test_gross_errors_near_the_epipoles_still_end_on_corresponding_lines() -> None:
    # Different focal lengths along x and y: Lindstrom's quadratic has no real root here.
    K = torch.tensor([[2000.0, 0, 320], [0, 200, 240], [0, 0, 1]]).double()
    pose = torch.eye(4).double().repeat(2, 1, 1)
    pose[1, 2, 3] = -0.5
    pose[1, :3, :3] = rigid(torch.tensor([0.0, 0, 1.5]), torch.zeros(3))[:3, :3]
    views = PosedViews(K.expand(2, 3, 3), pose)
    generator = torch.Generator().manual_seed(0)
    pixels = torch.tensor([320.0, 240]) + 30 * torch.randn(2, 2000, 2, generator=generator).double()
    result = triangulate_two_view(views.proj, pixels)
    assert result.valid.any()
    assert (epipolar_error(views, result.pixels)[result.valid].abs() < 1e-8).all()  # px
    shown = project(views, result.points)
    assert_close(shown.pixels[:, result.valid], result.pixels[:, result.valid], rtol=0, atol=1e-7)
    by_dlt = triangulate(views.proj, pixels)
    both = result.valid & by_dlt.valid
    assert (result.residual <= by_dlt.residual)[both].double().mean() > 0.95


def test_second_derivatives_are_right() -> None:
    scene = right_angle()

    def solve(pixels: Tensor) -> Tensor:
        return triangulate_two_view(scene.views.proj, pixels).points

    pixels = (scene.pixels + torch.tensor([[[3.0, -2.0]], [[1.0, 2.0]]])).requires_grad_()
    assert torch.autograd.gradgradcheck(solve, (pixels,), eps=1e-3, atol=1e-6)


def test_pixels_of_points_that_fail_stay_and_pass_no_gradient(dtype: torch.dtype) -> None:
    scene = forward_motion(dtype=dtype)
    pixels = scene.pixels[:, :1].repeat(1, 4, 1)
    pixels[:, 1] = pixels[:, 1].flip(0)  # the lines meet behind
    pixels[0, 2, 0] = torch.nan
    pixels[:, 3] = on_baseline(dtype=dtype).pixels[:, 0]  # both epipoles
    leaf = pixels.clone().requires_grad_()
    result = triangulate_two_view(scene.views.proj, leaf)
    assert result.valid.tolist() == [True, False, False, False]
    assert torch.equal(result.pixels[:, [1, 3]], pixels[:, [1, 3]])
    assert (result.pixels[0, 2] == 0).all()
    (gradient,) = torch.autograd.grad(result.pixels.sum(), leaf)
    assert (gradient[:, 1:] == 0).all() and (gradient[:, 0] != 0).any()


@pytest.mark.parametrize("view", [0, 1])
@pytest.mark.parametrize("angle", [5, 40, 90])
def test_a_pixel_on_its_epipole_shows_the_other_camera(angle: float, view: int) -> None:
    scene = turned(angle)
    center = camera_centers(scene.views.cam_from_world)[1 - view]
    x, y, w = (scene.views.proj[view] @ to_homogeneous(center)).tolist()
    pixels = scene.pixels.clone()
    pixels[view] = torch.tensor([x / w, y / w])
    result = triangulate_two_view(scene.views.proj, pixels)
    assert (result.status == Status.BEHIND_CAMERA).all()


@given(turn=vectors(1, within=3.0), shift=vectors(1, within=30.0))
def test_on_the_baseline_there_is_no_parallax_wherever_the_origin_is(
    turn: Tensor, shift: Tensor
) -> None:
    views, _, pixels = on_baseline()
    moved = PosedViews(views.K, views.cam_from_world @ rigid(turn, shift))
    result = triangulate_two_view(moved.proj, pixels)
    assert (result.status == Status.NO_PARALLAX).all()


def test_a_masked_pixel_may_hold_anything() -> None:
    scene = forward_motion()
    pixels = scene.pixels.clone()
    pixels[1, 0] = torch.nan
    mask = torch.tensor([[True, True, True], [False, True, True]])
    result = triangulate_two_view(scene.views.proj, pixels, mask)
    assert result.status.tolist() == [Status.TOO_FEW_VIEWS, Status.OK, Status.OK]
    assert_close(result.points[1:], scene.points[1:])


@pytest.mark.parametrize("spoiled", [torch.nan, torch.inf, 0.0])
def test_a_camera_without_an_image_is_told(spoiled: float) -> None:
    scene = forward_motion()
    proj = scene.views.proj.clone()
    proj[1] = spoiled
    proj.requires_grad_()
    result = triangulate_two_view(proj, scene.pixels)
    wanted = Status.NOT_FINITE_INPUT if spoiled else Status.NO_PARALLAX
    assert (result.status == wanted).all()
    gradient = torch.autograd.grad(result.points.sum() + result.residual.sum(), proj)[0]
    assert (gradient == 0).all()
