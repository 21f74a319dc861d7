"""Residual, parallax and covariance of given points."""

import math
from collections.abc import Callable
from functools import partial

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
NEAR = 1e-11  # of the largest: rounding, by a condition of 2e4, in whatever order is summed


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


def is_covariance(found: Tensor) -> bool:
    """Are matrices finite, symmetric and positive semidefinite within rounding?"""
    eps = torch.finfo(found.dtype).eps
    size = found.abs().amax(dim=(-2, -1), keepdim=True)
    # What has lost digits below the smallest normal number is as good as 0.
    unit = torch.where(size > torch.finfo(found.dtype).tiny / eps, found / size, 0.0).double()
    least = torch.linalg.eigvalsh(unit).amin() if found.isfinite().all() else -torch.inf
    return bool(least >= -32 * eps) and bool(((unit - unit.mT).abs() <= 32 * eps).all())


def test_wrong_arguments_are_named() -> None:
    scene, weights = forward_motion(), torch.ones(2, 3).double()
    sound = scene.views.proj, scene.points
    for call, error, reason in (
        (lambda: point_covariance(*sound, weights[:1]), ShapeError, "weights has V = 1 but proj"),
        (lambda: depth_variance(sound[0], torch.zeros(5, 3, 2)), ShapeError, "covariance"),
        (lambda: ray_parallax(*sound, torch.ones(2, 4) > 0), ShapeError, "used"),
        (lambda: reprojection_residual(*sound, scene.pixels[:1], weights), ShapeError, "pixels"),
        (lambda: point_covariance(sound[0].long(), sound[1], weights), TypeError, "proj must be"),
    ):
        with pytest.raises(error, match=reason):
            call()
    for shape in ((2, 6, 5), (3, 6, 6)):
        with pytest.raises(ShapeError, match="pose_covariance"):
            point_covariance(*sound, weights, pose_covariance=torch.zeros(shape).double())
    for function in (point_covariance, partial(reprojection_residual, pixels=scene.pixels)):
        with pytest.raises(ShapeError, match="mask has N = 2"):
            function(*sound, weights=weights, mask=weights[:, :2] > 0)
        with pytest.raises(TypeError, match="mask must be bool"):
            function(*sound, weights=weights, mask=weights)
        with pytest.raises(TypeError, match=r"weights must be a torch\.Tensor, got NoneType"):
            function(*sound, weights=None)


ARGUMENTS = {
    point_covariance: ("proj", "points", "weights", "mask", "pose_covariance"),
    reprojection_residual: ("proj", "points", "pixels", "weights", "mask"),
    ray_parallax: ("proj", "points", "used"),
    depth_variance: ("proj", "covariance"),
}


@pytest.mark.parametrize("function", ARGUMENTS)
def test_batch_dims_that_do_not_broadcast_are_named(function: Callable[..., Tensor]) -> None:
    used = torch.ones(2, 2, 3, dtype=torch.bool)
    batches_of_two = {
        "proj": torch.eye(3, 4).expand(2, 2, 3, 4),
        "points": torch.ones(2, 3, 3),
        "pixels": torch.ones(2, 2, 3, 2),
        "weights": torch.ones(2, 2, 3),
        "mask": used,
        "used": used,
        "covariance": torch.eye(3).expand(2, 3, 3, 3),
        "pose_covariance": torch.eye(6).expand(2, 2, 6, 6),
    }
    arguments = {name: batches_of_two[name] for name in ARGUMENTS[function]}
    assert function(**arguments).shape[0] == 2
    for name, two in arguments.items():
        three = torch.cat([two, two[:1]])
        with pytest.raises(ShapeError, match="leading batch dims must broadcast"):
            function(**(arguments | {name: three}))


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


WRONG = (torch.nan, torch.inf, -torch.inf, 1e200)


@given(
    drawn=weighted(),
    view=st.integers(0, 2),
    wrong=st.sampled_from(WRONG),
    by_mask=st.booleans(),
)
def test_an_unused_view_may_hold_anything(
    drawn: tuple[PosedScene, Tensor], view: int, wrong: float, by_mask: bool
) -> None:
    scene, weights = drawn
    rest = [other for other in range(3) if other != view]
    proj, pixels, noise = scene.views.proj.clone(), scene.pixels.clone(), pose_noise(3)
    proj[view], pixels[view], noise[view] = wrong, wrong, wrong
    mask = (torch.arange(3) != view)[:, None].expand(3, 4)
    spoilt = weights.clone()
    spoilt[view] = wrong if by_mask else 0
    inputs = [t.requires_grad_() for t in (proj, scene.points.clone(), pixels, spoilt, noise)]
    proj, points, pixels, spoilt, noise = inputs
    given_mask = mask if by_mask else None
    found = (
        point_covariance(proj, points, spoilt, mask=given_mask),
        point_covariance(proj, points, spoilt, mask=given_mask, pose_covariance=noise),
        reprojection_residual(proj, points, pixels, spoilt, mask=given_mask),
        ray_parallax(proj, points, mask),
    )
    sound = scene.views.proj[rest], scene.points
    wanted = (
        point_covariance(*sound, weights[rest]),
        point_covariance(*sound, weights[rest], pose_covariance=pose_noise(3)[rest]),
        reprojection_residual(*sound, scene.pixels[rest], weights[rest]),
        ray_parallax(*sound, mask[rest]),
    )
    for ours, theirs in zip(found, wanted, strict=True):
        assert_close(ours, theirs, rtol=0, atol=NEAR * max(1.0, float(theirs.abs().max())))
    total = sum(value.sum() for value in found[:3])
    assert isinstance(total, Tensor)
    for gradient, tensor in zip(torch.autograd.grad(total, inputs), inputs, strict=True):
        assert gradient.isfinite().all()
        if tensor is not points:
            assert (gradient[view] == 0).all()


FAILING = {
    "camera": {"covariance", "with poses", "residual", "parallax"},
    "point": {"covariance", "with poses", "residual", "parallax"},
    "weight": {"covariance", "with poses", "residual"},
    "pixel": {"residual"},
    "pose": {"with poses"},
}


@pytest.mark.parametrize("wrong", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("what", FAILING)
def test_of_a_point_with_something_used_that_is_not_finite_nothing_is_stated(
    what: str, wrong: float
) -> None:
    scene = three_views()
    proj, points, pixels = scene.views.proj.clone(), scene.points.clone(), scene.pixels + 1
    weights, noise = torch.ones(3, 2).double(), pose_noise(3)
    weights[1, 1] = 0  # the second point does without what is spoilt
    entry = {
        "camera": proj[1, 0, 2:3],
        "point": points[0, 1:2],
        "weight": weights[1, :1],
        "pixel": pixels[1, 0, :1],
        "pose": noise[1, 3, 4:5],
    }
    entry[what].fill_(wrong)
    inputs = [t.requires_grad_() for t in (proj, points, pixels, weights, noise)]
    found = {
        "covariance": point_covariance(proj, points, weights),
        "with poses": point_covariance(proj, points, weights, pose_covariance=noise),
        "residual": reprojection_residual(proj, points, pixels, weights),
        "parallax": ray_parallax(proj, points, weights != 0),
    }
    for name, value in found.items():
        assert value.isfinite().all(), name
        assert (value[0] == 0).all() == (name in FAILING[what]), name
        assert (value[1] != 0).all(), name
    for name in ("covariance", "with poses", "residual"):
        for gradient in torch.autograd.grad(found[name].sum(), inputs, allow_unused=True):
            assert gradient is None or gradient.isfinite().all(), name


def test_depths_in_a_camera_that_is_not_finite_are_0_and_in_others_as_before() -> None:
    scene = three_views()
    noise = point_covariance(scene.views.proj, scene.points, torch.ones(3, 2).double())
    wanted = depth_variance(scene.views.proj, noise)
    proj, spread = scene.views.proj.clone(), noise.clone()
    proj[1, 2, 1], spread[0, 1, 2] = torch.nan, torch.inf
    inputs = proj.requires_grad_(), spread.requires_grad_()
    found = depth_variance(*inputs)
    assert (found[1] == 0).all() and (found[:, 0] == 0).all()
    assert_close(found[[0, 2], 1], wanted[[0, 2], 1])
    for gradient in torch.autograd.grad(found.sum(), inputs):
        assert gradient.isfinite().all() and (gradient != 0).any()


@given(drawn=weighted(), keep=st.lists(st.booleans(), min_size=12, max_size=12))
def test_a_mask_is_a_weight_of_0(drawn: tuple[PosedScene, Tensor], keep: list[bool]) -> None:
    scene, weights = drawn
    mask = torch.tensor(keep).view(3, 4)
    proj, points, pixels = scene.views.proj, scene.points, scene.pixels + 1
    for options in ({}, {"pose_covariance": pose_noise(3)}):
        found = point_covariance(proj, points, weights, mask=mask, **options)
        assert torch.equal(found, point_covariance(proj, points, weights * mask, **options))
    seen = reprojection_residual(proj, points, pixels, weights, mask=mask)
    assert torch.equal(seen, reprojection_residual(proj, points, pixels, weights * mask))


def test_points_that_failed_state_nothing_if_they_are_left_out() -> None:
    scene = three_views()
    pose = scene.views.cam_from_world.clone()
    pose[:, 2, 3] += 2  # the origin, where failed points lie, is ahead
    scene = scene_from(PosedViews(scene.views.K, pose), scene.points)
    pixels, weights = scene.pixels.clone(), torch.ones(3, 2).double()
    pixels[1, 0] = torch.nan
    result = triangulate(scene.views.proj, pixels, weights, covariance=True)
    assert result.valid.tolist() == [False, True]
    proj, points = scene.views.proj, result.points
    assert (point_covariance(proj, points, weights)[0] != 0).all()  # that of the origin
    for found in (
        point_covariance(proj, points, weights * result.valid),
        point_covariance(proj, points, weights, mask=(weights > 0) & result.valid),
    ):
        assert_close(found, result.covariance, rtol=1e-9, atol=0)
        assert (found[0] == 0).all()


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


def test_the_largest_covariances_have_variances_that_are_numbers() -> None:
    most = torch.finfo(torch.float64).max
    proj = torch.eye(3, 4).double()[None].clone()
    proj[0, 2, :3] = torch.tensor([0.8, 0.55, -0.24])
    covariance = most * torch.stack([torch.ones(3, 3), torch.eye(3)]).double()
    assert_close(depth_variance(proj, covariance), torch.full((1, 2), most, dtype=torch.float64))


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
        assert is_covariance(point_covariance(*inputs))
        assert is_covariance(point_covariance(*inputs, pose_covariance=noise))
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


@pytest.mark.parametrize("kind", [torch.float32, torch.float64], ids=str)
def test_what_is_too_large_for_the_dtype_is_a_multiple_of_the_identity(kind: torch.dtype) -> None:
    scene, largest = three_views(), torch.finfo(kind).max
    proj, points = (tensor.to(kind) for tensor in (scene.views.proj, scene.points))
    weights = torch.tensor([largest**-0.9, 1.0], dtype=kind).expand(3, 2).contiguous()
    inputs = [tensor.requires_grad_() for tensor in (proj, points, weights)]
    for noise in (None, pose_noise(3).to(kind)):
        found = point_covariance(*inputs, pose_covariance=noise)
        assert torch.equal(found[0], largest * torch.eye(3, dtype=kind))
        assert is_covariance(found) and (found[1].abs() < 1).all()
        depth = depth_variance(proj, found)
        assert depth.dtype == kind and depth.isfinite().all() and (depth[:, 0] > largest / 2).all()
        for gradient in torch.autograd.grad(found.sum(), inputs):
            assert gradient.isfinite().all() and (gradient != 0).any()


def test_views_that_tell_nothing_of_a_point_state_the_largest_variance() -> None:
    # The same pixel wherever a point is: no direction is known, and 1 m^2 would be a claim.
    proj = torch.tensor([[0.0, 0, 0, 3], [0, 0, 0, 2], [0, 0, 0, 1]]).double().expand(2, 3, 4)
    found = point_covariance(proj, torch.ones(1, 3).double(), torch.ones(2, 1).double())
    assert torch.equal(found[0], torch.finfo(torch.float64).max * torch.eye(3).double())
    # As far away as to be below the range of numbers.
    far = torch.tensor([[0.0, 0.0, 1e70]], dtype=torch.float64)
    views = three_views().views.proj
    found = point_covariance(views, far, torch.ones(3, 1).double())
    assert is_covariance(found) and (found[0].diagonal() > 1e100).all()


def test_weights_whose_squares_no_number_holds_are_weights() -> None:
    scene, ones = three_views(), torch.ones(3, 2).double()
    zoom = torch.tensor([1e10, 1e10, 1.0]).double().diag()
    near = point_covariance(zoom @ scene.views.proj, scene.points, ones)
    found = point_covariance(zoom @ scene.views.proj, scene.points, 1e-160 * ones)
    assert_close(found * 1e-300, near * 1e20)
    pixels = scene.pixels + 1
    for size in (1e-200, 1e200):
        residual = reprojection_residual(scene.views.proj, scene.points, pixels, size * ones)
        assert_close(residual, 2**0.5 * ones[0])  # px


@pytest.mark.slow
def test_vmap_is_a_batch_dim_and_traced_as_one_graph_it_is_the_same() -> None:
    scene, noise = three_views(), pose_noise(3)
    weights = torch.tensor([[2.0, 1, 0], [3, 1, 1]]).double()[..., None].expand(2, 3, 2)

    def of_depth(proj: Tensor, points: Tensor, weights: Tensor) -> Tensor:
        found = point_covariance(proj, points, weights, mask=weights < 2.5, pose_covariance=noise)
        return depth_variance(proj, found)

    wanted = of_depth(scene.views.proj, scene.points, weights)
    mapped = torch.func.vmap(of_depth, in_dims=(None, None, 0))
    assert_close(mapped(scene.views.proj, scene.points, weights), wanted)
    torch.compiler.reset()
    traced = torch.compile(of_depth, fullgraph=True, backend="aot_eager")
    assert_close(traced(scene.views.proj, scene.points, weights), wanted)
    torch.compiler.reset()


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
