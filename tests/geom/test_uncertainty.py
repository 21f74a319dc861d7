"""Residual, parallax and covariance of given points."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import (
    PosedViews,
    ShapeError,
    camera_centers,
    depth_variance,
    point_covariance,
    project,
    ray_parallax,
    refine_points,
    reprojection_residual,
    triangulate,
)
from deltas_geom.testing import PosedScene, default_intrinsics, forward_motion, rigid, scene_from
from deltas_geom.testing.strategies import extreme, posed_scenes, scales, vectors

TRIALS = 4000


@st.composite
def weighted(draw: st.DrawFn, num_views: int = 3) -> tuple[PosedScene, Tensor]:
    """A scene of four points and weights of 0.2 to 1 per px."""
    scene = draw(posed_scenes(num_views=num_views))
    return scene, 0.6 + draw(vectors(num_views, within=0.4, size=4))


def three_views() -> PosedScene:
    """Three cameras 30 cm beside each other, turned towards points 3 and 4 m ahead."""
    turn = torch.tensor([[0.0, -0.1, 0.0], [0.05, 0, 0.1], [0, 0.1, -0.05]]).double()
    pose = rigid(turn, torch.zeros(3, 3).double())
    center = torch.tensor([[-0.3, 0.0, 0.0], [0.0, 0.1, -0.1], [0.3, 0, 0.1]]).double()
    pose[:, :3, 3] = -(pose[:, :3, :3] @ center[..., None])[..., 0]
    points = torch.tensor([[0.3, 0.2, 3.0], [-0.4, 0.1, 4.0]]).double()
    return scene_from(PosedViews(default_intrinsics().expand(3, 3, 3), pose), points)


def pose_noise(num_views: int) -> Tensor:
    """Covariances ``(V, 6, 6)`` around 4 mm and 1 mrad, all entries correlated."""
    generator = torch.Generator().manual_seed(1)
    size = torch.tensor([4e-3, 3e-3, 5e-3, 1e-3, 1.5e-3, 5e-4]).double()
    factor = torch.eye(6).double() + 0.4 * torch.randn(
        num_views, 6, 6, generator=generator, dtype=torch.float64
    )
    factor = size[:, None] * factor
    return factor @ factor.mT


def moved(views: PosedViews, change: Tensor) -> PosedViews:
    """Cameras whose centres moved and that turned, both along the world's axes.

    Args:
        views: V cameras.
        change: ``(*B, V, 6)`` of the centre (m) and the rotation vector (rad).
    """
    pose = views.cam_from_world
    turn = rigid(change[..., 3:], torch.zeros_like(change[..., 3:]))[..., :3, :3]
    rotation = pose[..., :3, :3] @ turn.mT  # the camera's axes in the world are turned
    center = camera_centers(pose) + change[..., :3]
    shift = -(rotation @ center[..., None])
    last = pose[..., 3:, :].expand(*change.shape[:-1], 1, 4)
    moved_pose = torch.cat([torch.cat([rotation, shift], dim=-1), last], dim=-2)
    return PosedViews(views.K.expand(*change.shape[:-1], 3, 3), moved_pose)


def test_wrong_shapes_are_named() -> None:
    scene = forward_motion()
    proj, points = scene.views.proj, scene.points
    weights = torch.ones(2, 3).double()
    with pytest.raises(ShapeError, match="weights has V = 1 but proj has V = 2"):
        point_covariance(proj, points, weights[:1])
    with pytest.raises(ShapeError, match="pose_covariance"):
        point_covariance(proj, points, weights, pose_covariance=torch.zeros(2, 6, 5).double())
    with pytest.raises(ShapeError, match="V = 3"):
        point_covariance(proj, points, weights, pose_covariance=torch.zeros(3, 6, 6).double())
    with pytest.raises(ShapeError, match="covariance"):
        depth_variance(proj, torch.zeros(5, 3, 2))
    with pytest.raises(ShapeError, match="used"):
        ray_parallax(proj, points, torch.ones(2, 4, dtype=torch.bool))
    with pytest.raises(ShapeError, match="pixels"):
        reprojection_residual(proj, points, torch.zeros(3, 3, 2).double(), weights)


def test_batch_dims_broadcast(dtype: torch.dtype) -> None:
    scene = forward_motion(dtype=dtype)
    proj = scene.views.proj.expand(5, 1, 2, 3, 4)
    points, weights = scene.points.expand(6, 3, 3), torch.ones(2, 3, dtype=dtype)
    poses = torch.eye(6, dtype=dtype).expand(2, 6, 6)
    found = point_covariance(proj, points, weights, pose_covariance=poses)
    assert found.shape == (5, 6, 3, 3, 3) and found.dtype == dtype
    alone = point_covariance(scene.views.proj, scene.points, weights, pose_covariance=poses)
    assert_close(found[4, 3], alone)
    assert depth_variance(proj, found).shape == (5, 6, 2, 3)
    used = torch.ones(2, 3, dtype=torch.bool)
    angle = ray_parallax(proj, points, used)
    assert angle.shape == (5, 6, 3) and angle.dtype == dtype
    residual = reprojection_residual(proj, points, scene.pixels, weights)
    assert residual.shape == (5, 6, 3) and residual.dtype == dtype


@given(drawn=weighted(), factor=scales(decades=3))
def test_twice_the_noise_is_four_times_the_covariance(
    drawn: tuple[PosedScene, Tensor], factor: float
) -> None:
    scene, weights = drawn
    one = point_covariance(scene.views.proj, scene.points, weights)
    many = point_covariance(scene.views.proj, scene.points, weights / factor)
    size = factor**2 * float(one.abs().max())
    assert_close(many, factor**2 * one, rtol=0, atol=1e-12 * size)


@given(drawn=weighted(), turn=vectors(1, within=3.0), shift=vectors(1, within=10.0))
def test_the_covariance_turns_with_the_world(
    drawn: tuple[PosedScene, Tensor], turn: Tensor, shift: Tensor
) -> None:
    scene, weights = drawn
    new_from_world = rigid(turn, shift)[0]
    rotation, translation = new_from_world[:3, :3], new_from_world[:3, 3]
    pose = scene.views.cam_from_world @ torch.linalg.inv(new_from_world)
    points = scene.points @ rotation.mT + translation
    both = torch.block_diag(rotation, rotation)
    noise = pose_noise(3)
    one = point_covariance(scene.views.proj, scene.points, weights, pose_covariance=noise)
    other = point_covariance(
        PosedViews(scene.views.K, pose).proj,
        points,
        weights,
        pose_covariance=both @ noise @ both.mT,
    )
    size = float(one.abs().max())
    assert_close(other, rotation @ one @ rotation.mT, rtol=0, atol=1e-9 * size)


@given(drawn=weighted())
def test_a_covariance_is_symmetric_and_positive_and_grows_with_the_poses(
    drawn: tuple[PosedScene, Tensor],
) -> None:
    scene, weights = drawn
    one = point_covariance(scene.views.proj, scene.points, weights)
    more = point_covariance(scene.views.proj, scene.points, weights, pose_covariance=pose_noise(3))
    for covariance in (one, more, more - one):
        assert_close(covariance, covariance.mT, rtol=1e-9, atol=1e-15)
        values = torch.linalg.eigvalsh(covariance)
        assert (values >= -1e-12 * values[..., -1:]).all()
    none = torch.zeros(3, 6, 6).double()
    same = point_covariance(scene.views.proj, scene.points, weights, pose_covariance=none)
    assert_close(same, one)


@given(drawn=weighted(), shift=vectors(1, within=1e-2))
def test_moving_all_cameras_alike_moves_the_point_with_them(
    drawn: tuple[PosedScene, Tensor], shift: Tensor
) -> None:
    # First order, so exact: the sum over views of their responses is the whole rig's response.
    scene, weights = drawn
    noise = torch.zeros(3, 6, 6).double()
    noise[:, :3, :3] = shift.mT @ shift
    proj = scene.views.proj
    one = point_covariance(proj, scene.points, weights)
    alone = []
    for view in range(3):
        some = torch.zeros_like(noise)
        some[view] = noise[view]
        alone.append(point_covariance(proj, scene.points, weights, pose_covariance=some) - one)
    all_of_them = point_covariance(proj, scene.points, weights, pose_covariance=noise) - one
    size = float(one.abs().max())
    assert_close(all_of_them, sum(alone), rtol=1e-9, atol=1e-9 * size)
    # Each is of one direction r_v r_v^T, and the r_v of a common shift add up to it.
    response = [matrix.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt() for matrix in alone]
    assert (sum(response) >= shift.abs() * (1 - 1e-6) - 1e-4 * size**0.5).all()


@given(drawn=weighted(), view=st.integers(0, 2))
def test_an_unused_view_tells_nothing(drawn: tuple[PosedScene, Tensor], view: int) -> None:
    scene, weights = drawn
    rest = [other for other in range(3) if other != view]
    weights = weights.clone()
    weights[view] = 0
    noise = pose_noise(3)
    found = point_covariance(scene.views.proj, scene.points, weights, pose_covariance=noise)
    wanted = point_covariance(
        scene.views.proj[rest], scene.points, weights[rest], pose_covariance=noise[rest]
    )
    size = float(wanted.abs().max())
    assert_close(found, wanted, rtol=0, atol=1e-12 * size)


@given(drawn=weighted())
def test_it_is_the_covariance_of_triangulated_points(drawn: tuple[PosedScene, Tensor]) -> None:
    scene, weights = drawn
    result = triangulate(scene.views.proj, scene.pixels, weights, covariance=True)
    stated = point_covariance(scene.views.proj, result.points, weights)
    size = float(stated.abs().max())
    assert_close(stated, result.covariance, rtol=1e-9, atol=1e-12 * size)


@given(drawn=weighted())
def test_the_covariance_is_the_inverse_of_an_autograd_hessian(
    drawn: tuple[PosedScene, Tensor],
) -> None:
    scene, weights = drawn
    found = point_covariance(scene.views.proj, scene.points, weights)
    for point in range(4):

        def seen(place: Tensor, point: int = point) -> Tensor:
            pixels = project(scene.views, place[None]).pixels[:, 0]
            return weights[:, point, None] * pixels

        slope = torch.func.jacrev(seen)(scene.points[point]).flatten(0, 1)
        wanted = torch.linalg.inv(slope.mT @ slope)
        assert_close(found[point], wanted, rtol=1e-7, atol=1e-12)


@given(drawn=weighted(), factor=vectors(3, within=1.0))
def test_depth_variance_is_that_of_linear_depth(
    drawn: tuple[PosedScene, Tensor], factor: Tensor
) -> None:
    scene, _ = drawn
    covariance = (factor @ factor.mT).expand(4, 3, 3)

    def depth(place: Tensor) -> Tensor:
        return project(scene.views, place[None]).depth[:, 0]

    slope = torch.func.jacrev(depth)(scene.points[0])  # (V, 3)
    wanted = ((slope @ factor).square().sum(dim=-1))[:, None].expand(3, 4)
    found = depth_variance(scene.views.proj, covariance)
    assert_close(found, wanted, rtol=1e-9, atol=1e-12)


@given(drawn=weighted(), drop=st.integers(-1, 2))
def test_parallax_is_the_largest_angle_between_rays(
    drawn: tuple[PosedScene, Tensor], drop: int
) -> None:
    scene, _ = drawn
    used = torch.ones(3, 4, dtype=torch.bool)
    if drop >= 0:
        used[drop, :2] = False
    found = ray_parallax(scene.views.proj, scene.points, used)
    centers = camera_centers(scene.views.cam_from_world)
    for point in range(4):
        rays = (scene.points[point] - centers)[used[:, point]]
        angles = [
            math.atan2(float(torch.linalg.cross(a, b).norm()), float(a @ b))
            for a in rays
            for b in rays
        ]
        assert_close(float(found[point]), max(angles), rtol=0, atol=1e-12)  # rad


@given(angle=st.floats(-9.0, 0.0).map(lambda power: 10.0**power), far=scales(decades=3))
def test_parallax_keeps_small_angles(angle: float, far: float) -> None:
    # Centres as far apart as the chord, at the same distance from a point at the origin.
    pose = torch.eye(4).double().repeat(2, 1, 1)
    pose[:, 0, 3] = torch.tensor([0.5, -0.5]).double() * 2 * far * math.sin(angle / 2)
    pose[:, 2, 3] = far * math.cos(angle / 2)
    used = torch.ones(2, 1, dtype=torch.bool)
    found = ray_parallax(pose[:, :3], torch.zeros(1, 3).double(), used)
    assert_close(float(found), angle, rtol=1e-7, atol=1e-15)


@given(points=extreme(4, 3), weights=extreme(3, 4), proj=extreme(3, 3, 4), wild=st.booleans())
def test_no_finite_input_gives_nan_or_inf(
    points: Tensor, weights: Tensor, proj: Tensor, wild: bool
) -> None:
    cameras = proj if wild else three_views().views.proj
    for dtype in (torch.float32, torch.float64):
        # Squares of weights and products of poses have to be representable.
        power = 0.25 if dtype == torch.float32 else 1
        inputs = [
            (value.sign() * value.abs() ** power).to(dtype) for value in (cameras, points, weights)
        ]
        noise = pose_noise(3).to(dtype)
        assert point_covariance(*inputs).isfinite().all()
        assert point_covariance(*inputs, pose_covariance=noise).isfinite().all()
        angle = ray_parallax(inputs[0], inputs[1], inputs[2] != 0)
        assert angle.isfinite().all() and (angle >= 0).all() and (angle <= math.pi).all()
        seen = reprojection_residual(
            inputs[0], inputs[1], torch.zeros(3, 4, 2, dtype=dtype), inputs[2]
        )
        assert not seen.isnan().any()


def test_pixel_and_pose_noise_are_what_monte_carlo_finds() -> None:
    scene, noise = three_views(), pose_noise(3)
    weights = torch.tensor([[2.0], [4.0], [3.0]]).double().expand(3, 2)  # 1 / px
    generator = torch.Generator().manual_seed(0)
    drawn = torch.randn(TRIALS, 3, 6, generator=generator, dtype=torch.float64)
    change = (torch.linalg.cholesky(noise) @ drawn[..., None])[..., 0]
    error = torch.randn(TRIALS, 3, 2, 2, generator=generator, dtype=torch.float64)
    # The true cameras see the points; those one believes in are off.
    believed = moved(scene.views, change).proj
    pixels = scene.pixels + error / weights[..., None]
    start = scene.points.expand(TRIALS, 2, 3)
    found = refine_points(believed, pixels, start, weights, steps=5)
    assert found.valid.all()
    proj = scene.views.proj
    of_pixels = point_covariance(proj, scene.points, weights)
    stated = point_covariance(proj, scene.points, weights, pose_covariance=noise)
    for point in range(2):
        whitened = torch.linalg.cholesky(stated[point]).inverse() @ found.points[:, point].mT
        # 4000 trials: an entry's own deviation is 1 / sqrt(2000) = 2 %, and less off the diagonal.
        assert_close(torch.cov(whitened), torch.eye(3).double(), rtol=0, atol=0.1)
        # Neither noise alone would pass.
        share = torch.linalg.solve(stated[point], of_pixels[point]).diagonal().sum() / 3
        assert 0.03 < share < 0.6


def test_turning_and_shifting_a_camera_are_told_apart() -> None:
    scene = three_views()
    weights = torch.ones(3, 2).double()
    proj = scene.views.proj
    of_pixels = point_covariance(proj, scene.points, weights)
    step = 1e-5
    for entry in range(6):
        for view in range(3):
            noise = torch.zeros(3, 6, 6).double()
            noise[view, entry, entry] = 1.0
            stated = point_covariance(proj, scene.points, weights, pose_covariance=noise)
            change = torch.zeros(2, 3, 6).double()
            change[0, view, entry], change[1, view, entry] = step, -step
            believed = moved(scene.views, change).proj
            start = scene.points.expand(2, 2, 3)
            found = refine_points(believed, scene.pixels, start, steps=10).points
            slope = (found[0] - found[1]) / (2 * step)
            wanted = slope[:, :, None] * slope[:, None, :]
            size = float(wanted.abs().max())
            assert_close(stated - of_pixels, wanted, rtol=0, atol=1e-5 * size)


def test_depth_variance_is_what_monte_carlo_finds() -> None:
    scene = three_views()
    covariance = point_covariance(scene.views.proj, scene.points, torch.ones(3, 2).double())
    stated = depth_variance(scene.views.proj, covariance)
    generator = torch.Generator().manual_seed(0)
    drawn = torch.randn(TRIALS, 2, 3, generator=generator, dtype=torch.float64)
    points = scene.points + (torch.linalg.cholesky(covariance) @ drawn[..., None])[..., 0]
    views = PosedViews(*(tensor.expand(TRIALS, *tensor.shape) for tensor in scene.views))
    measured = project(views, points).depth.var(dim=0)
    assert_close(measured, stated, rtol=0.1, atol=0)  # 4000 trials: 2 % each


def test_fewer_than_two_views_state_nothing_and_one_line_states_a_large_variance() -> None:
    scene = three_views()
    proj, one = scene.views.proj, torch.tensor([1.0, 0, 0]).double()[:, None].expand(3, 2)
    assert (point_covariance(proj, scene.points, one) == 0).all()
    noise = pose_noise(3)
    assert (point_covariance(proj, scene.points, one, pose_covariance=noise) == 0).all()
    assert (ray_parallax(proj, scene.points, one != 0) == 0).all()
    # The same camera twice sees no depth: its variance is as large as it is finite.
    twice = point_covariance(proj[[0, 0]], scene.points, torch.ones(2, 2).double())
    assert twice.isfinite().all()
    depth = depth_variance(proj[:1], twice)[0]
    assert (depth > 1e6).all()  # m^2
    behind = torch.tensor([[0.0, 0.0, -3.0]]).double()
    assert (point_covariance(proj, behind, torch.ones(3, 1).double()) == 0).all()


def test_they_are_differentiable() -> None:
    scene = three_views()
    inputs = tuple(
        value.clone().requires_grad_()
        for value in (scene.views.proj, scene.points, 2 * torch.ones(3, 2).double(), pose_noise(3))
    )

    def covariance(proj: Tensor, points: Tensor, weights: Tensor, noise: Tensor) -> Tensor:
        found = point_covariance(proj, points, weights, pose_covariance=noise)
        return 1e4 * depth_variance(proj, found)

    assert torch.autograd.gradcheck(covariance, (*inputs[:3], inputs[3].detach()), atol=1e-4)
    of_noise = torch.autograd.grad(covariance(*inputs).sum(), inputs[3])[0]
    assert of_noise.isfinite().all() and (of_noise != 0).any()
