"""Weighted, masked n-view triangulation: its invariants, and its answer against other solvers."""

from collections.abc import Callable
from typing import Any

import cv2
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.geometry.epipolar import triangulate_points as kornia_triangulate
from torch import Tensor
from torch.testing import assert_close
from triangulation_cases import noisy, svd_points

from deltas_geom import (
    PosedViews,
    ShapeError,
    Status,
    camera_centers,
    point_covariance,
    project,
    ray_parallax,
    reprojection_residual,
    triangulate,
    triangulate_points,
    triangulate_robust,
)
from deltas_geom.testing import (
    PosedScene,
    default_intrinsics,
    forward_motion,
    right_angle,
    rigid,
    scene_from,
)
from deltas_geom.testing.strategies import posed_scenes, scales, vectors


def test_wrong_arguments_are_named() -> None:
    proj, pixels = torch.zeros(2, 3, 4), torch.zeros(2, 5, 2)
    with pytest.raises(ShapeError, match="pixels has V = 3 but proj has V = 2"):
        triangulate(proj, torch.zeros(3, 5, 2))
    with pytest.raises(ShapeError, match="weights has N = 4 but pixels has N = 5"):
        triangulate(proj, pixels, torch.ones(2, 4))
    with pytest.raises(ShapeError, match="mask has V = 1 but pixels has V = 2"):
        triangulate(proj, pixels, mask=torch.ones(1, 5, dtype=torch.bool))
    with pytest.raises(ValueError, match="frame must be 'rig' or 'world', got 'rigid'"):
        triangulate(proj, pixels, frame="rigid")  # type: ignore[arg-type]


@pytest.mark.parametrize("operation", [triangulate, triangulate_points, triangulate_robust])
def test_arguments_of_another_kind_are_named(operation: Callable[..., Any]) -> None:
    proj, pixels, weights = torch.zeros(2, 3, 4), torch.zeros(2, 5, 2), torch.ones(2, 5)
    with pytest.raises(TypeError, match=r"weights must be a torch\.Tensor"):
        operation(proj, pixels, weights.numpy())
    with pytest.raises(TypeError, match=r"mask must be a torch\.Tensor"):
        operation(proj, pixels, mask=weights.bool().numpy())
    with pytest.raises(TypeError, match=r"proj must be floating point, got torch\.int64"):
        operation(proj.long(), pixels)
    with pytest.raises(ShapeError, match="leading batch dims must broadcast"):
        operation(proj.expand(3, -1, -1, -1), pixels.expand(2, -1, -1, -1))


def test_batch_dims_broadcast(dtype: torch.dtype) -> None:
    scene = forward_motion(dtype=dtype)
    pixels = scene.pixels.expand(4, 1, 2, 3, 2)
    weights = torch.ones(5, 2, 3, dtype=dtype)
    result = triangulate(scene.views.proj, pixels, weights, covariance=True)
    assert result.points.shape == (4, 5, 3, 3) and result.points.dtype == dtype
    assert result.depth.shape == (4, 5, 2, 3) and result.status.dtype == torch.int8
    assert result.status.shape == result.residual.shape == result.parallax.shape == (4, 5, 3)
    assert result.covariance is not None and result.covariance.shape == (4, 5, 3, 3, 3)
    many = triangulate(scene.views.proj.expand(6, 2, 3, 4), scene.pixels)
    assert many.points.shape == (6, 3, 3)
    assert_close(many.points[5], triangulate_points(scene.views.proj, scene.pixels))


def test_no_points_and_a_single_view_are_no_error() -> None:
    proj = forward_motion().views.proj
    assert triangulate(proj, torch.zeros(2, 0, 2).double(), covariance=True).points.shape == (0, 3)
    alone = triangulate(proj[:1], torch.zeros(1, 4, 2).double())
    assert (alone.status == Status.TOO_FEW_VIEWS).all()


@given(scene=posed_scenes(num_views=3))
@pytest.mark.parametrize("frame", ["rig", "world"])
def test_without_noise_triangulation_is_exact(frame: str, scene: PosedScene) -> None:
    result = triangulate(scene.views.proj, scene.pixels, frame=frame)  # type: ignore[arg-type]
    assert result.valid.all()
    assert_close(result.points, scene.points, rtol=0, atol=1e-9)  # m
    assert_close(result.depth, project(scene.views, scene.points).depth, rtol=0, atol=1e-9)
    assert (result.residual < 1e-7).all()  # px


@given(
    drawn=noisy(),
    turn=vectors(1, within=3.0),
    shift=vectors(1, within=10.0),
    scale=scales(decades=2),
)
def test_points_move_with_the_world(
    drawn: tuple[PosedScene, Tensor], turn: Tensor, shift: Tensor, scale: float
) -> None:
    scene, weights = drawn
    new_from_world = rigid(turn, shift)[0]
    rotation, translation = new_from_world[:3, :3], new_from_world[:3, 3]
    cam_from_new = scene.views.cam_from_world @ torch.linalg.inv(new_from_world)
    cam_from_new[:, :3, 3] *= scale
    proj = PosedViews(scene.views.K, cam_from_new).proj
    points = triangulate_points(scene.views.proj, scene.pixels, weights)
    moved = triangulate_points(proj, scene.pixels, weights)
    wanted = scale * (points @ rotation.mT + translation)
    assert_close(moved, wanted, rtol=0, atol=1e-8 * scale)  # 10 nm in the old unit


@given(drawn=noisy(), left=st.integers(-99, 99), top=st.integers(-99, 99))
def test_points_do_not_know_that_the_images_were_cropped_and_resized(
    drawn: tuple[PosedScene, Tensor], left: int, top: int
) -> None:
    scene, weights = drawn
    views = scene.views.crop(left=left, top=top).resize(old_size=(480, 640), new_size=(240, 320))
    pixels = (scene.pixels - torch.tensor([left, top]) + 0.5) / 2 - 0.5
    assert_close(
        triangulate_points(views.proj, pixels, weights),
        triangulate_points(scene.views.proj, scene.pixels, weights),
        rtol=0,
        atol=1e-9,  # m
    )


@given(drawn=noisy(), factor=scales(decades=200))
def test_only_the_ratios_of_weights_count(drawn: tuple[PosedScene, Tensor], factor: float) -> None:
    scene, weights = drawn
    result = triangulate(scene.views.proj, scene.pixels, weights)
    scaled = triangulate(scene.views.proj, scene.pixels, factor * weights)
    assert_close(scaled.points, result.points, rtol=0, atol=1e-10)  # m
    assert_close(scaled.residual, result.residual, rtol=0, atol=1e-9)  # px


@given(drawn=noisy(), order=st.permutations([0, 1, 2]))
def test_the_order_of_views_does_not_count(
    drawn: tuple[PosedScene, Tensor], order: list[int]
) -> None:
    scene, weights = drawn
    result = triangulate(scene.views.proj, scene.pixels, weights)
    other = triangulate(scene.views.proj[order], scene.pixels[order], weights[order])
    assert_close(other.points, result.points, rtol=0, atol=1e-10)  # m
    assert_close(other.depth, result.depth[order], rtol=0, atol=1e-10)


@given(drawn=noisy(), view=st.integers(0, 2), by_mask=st.booleans(), spoil=st.booleans())
def test_a_view_that_is_masked_or_of_weight_0_is_a_view_removed(
    drawn: tuple[PosedScene, Tensor], view: int, by_mask: bool, spoil: bool
) -> None:
    scene, weights = drawn
    rest = [other for other in range(3) if other != view]
    wanted = triangulate(scene.views.proj[rest], scene.pixels[rest], weights[rest], covariance=True)
    pixels, proj = scene.pixels.clone(), scene.views.proj.clone()
    pixels[view] = torch.nan
    if spoil:
        proj[view] = torch.nan
    mask = torch.ones(3, 4, dtype=torch.bool)
    if by_mask:
        mask[view] = False
    else:
        weights = weights.clone()
        weights[view] = 0
    result = triangulate(proj, pixels, weights, mask, covariance=True)
    assert_close(result.points, wanted.points, rtol=0, atol=1e-10)  # m
    assert (result.status == wanted.status).all()
    assert_close(result.residual, wanted.residual, rtol=0, atol=1e-9)  # px
    assert_close(result.parallax, wanted.parallax, rtol=0, atol=1e-12)  # rad
    assert_close(result.covariance, wanted.covariance, rtol=1e-9, atol=1e-12)  # m^2
    assert_close(result.depth[rest], wanted.depth, rtol=0, atol=1e-10)


@given(drawn=noisy(), far=scales(decades=9))
def test_a_masked_camera_may_stand_anywhere(drawn: tuple[PosedScene, Tensor], far: float) -> None:
    scene, weights = drawn
    proj = scene.views.proj.clone()
    proj[2, :, 3] = far * proj[2, :, :3].sum(dim=-1)
    mask = torch.tensor([True, True, False])[:, None].expand(3, 4)
    for dtype in (torch.float32, torch.float64):
        inputs = proj.to(dtype), scene.pixels.to(dtype), weights.to(dtype)
        wanted = triangulate(*(value[:2] for value in inputs))
        result = triangulate(*inputs, mask)
        assert (result.status == wanted.status).all()
        assert_close(result.points, wanted.points, rtol=1e-6, atol=1e-6)  # m


@given(drawn=noisy(), view=st.integers(0, 2))
def test_a_doubled_view_is_a_doubled_squared_weight(
    drawn: tuple[PosedScene, Tensor], view: int
) -> None:
    scene, weights = drawn
    twice = [0, 1, 2, view]
    doubled = triangulate_points(scene.views.proj[twice], scene.pixels[twice], weights[twice])
    weights = weights.clone()
    weights[view] *= 2**0.5
    heavier = triangulate_points(scene.views.proj, scene.pixels, weights)
    assert_close(doubled, heavier, rtol=0, atol=1e-10)  # m


@given(drawn=noisy())
def test_float32_is_within_its_bound_of_float64(drawn: tuple[PosedScene, Tensor]) -> None:
    scene, weights = drawn
    inputs = [value.float() for value in (scene.views.proj, scene.pixels, weights)]
    single = triangulate_points(*inputs)
    exact = triangulate_points(*(value.double() for value in inputs))
    # Solved in float64 either way: only the result is rounded, at 5 m.
    assert_close(single.double(), exact, rtol=0, atol=6e-8 * 8)  # m


@given(drawn=noisy())
@pytest.mark.parametrize("frame", ["rig", "world"])
def test_the_answer_is_that_of_an_svd(frame: str, drawn: tuple[PosedScene, Tensor]) -> None:
    scene, weights = drawn
    proj = scene.views.proj
    ours = triangulate_points(proj, scene.pixels, weights, frame=frame)  # type: ignore[arg-type]
    if frame == "world":
        assert_close(ours, svd_points(proj, scene.pixels, weights), rtol=0, atol=1e-8)  # m
        return
    centers = camera_centers(scene.views.cam_from_world)
    for point in range(4):
        share = weights[:, point].square() / weights[:, point].square().sum()
        origin = share @ centers
        unit = (share @ (centers - origin).square().sum(dim=-1)).sqrt()
        world_from_rig = torch.eye(4, dtype=torch.float64)
        world_from_rig[:3] = torch.cat([unit * torch.eye(3).double(), origin[:, None]], dim=1)
        some = slice(point, point + 1)
        local = svd_points(proj @ world_from_rig, scene.pixels[:, some], weights[:, some])
        assert_close(ours[some], local * unit + origin, rtol=0, atol=1e-8)  # m


@given(drawn=noisy(num_views=2))
def test_opencv_and_kornia_agree_in_the_worlds_frame(drawn: tuple[PosedScene, Tensor]) -> None:
    scene, _ = drawn
    proj, (first, second) = scene.views.proj, scene.pixels
    ours = triangulate_points(proj, scene.pixels, frame="world")
    by_opencv = cv2.triangulatePoints(
        proj[0].numpy(), proj[1].numpy(), first.numpy().T, second.numpy().T
    )
    assert_close(ours, torch.from_numpy(by_opencv[:3] / by_opencv[3]).mT, rtol=0, atol=1e-7)  # m
    by_kornia = kornia_triangulate(proj[:1], proj[1:], first[None], second[None])[0]
    assert_close(ours, by_kornia, rtol=0, atol=1e-6)  # m


def test_the_covariance_is_what_monte_carlo_finds() -> None:
    generator = torch.Generator().manual_seed(0)
    pose = torch.eye(4).double().repeat(3, 1, 1)
    pose[:, 0, 3] = torch.tensor([0.0, -0.3, -0.6])
    views = PosedViews(default_intrinsics().expand(3, 3, 3), pose)
    scene = scene_from(views, torch.tensor([[0.3, 0.2, 3.0], [-0.4, 0.1, 4.0]]).double())
    weights = torch.tensor([[2.0], [4.0], [3.0]]).double().expand(3, 2)  # 1 / px
    noise = torch.randn(4000, 3, 2, 2, generator=generator, dtype=torch.float64)
    pixels = scene.pixels + noise / weights[..., None]
    points = triangulate_points(views.proj, pixels, weights.expand(4000, 3, 2))
    stated = triangulate(views.proj, scene.pixels, weights, covariance=True).covariance
    assert stated is not None
    for point in range(2):
        whitened = torch.linalg.cholesky(stated[point]).inverse() @ points[:, point].mT
        measured = torch.cov(whitened)
        # 4000 trials: an entry's own deviation is 1 / sqrt(2000) = 2 %.
        assert_close(measured, torch.eye(3).double(), rtol=0, atol=0.1)


def test_what_is_known_of_given_points() -> None:
    scene = right_angle()
    used = torch.ones(2, 1, dtype=torch.bool)
    angle = ray_parallax(scene.views.proj, scene.points, used)
    assert_close(angle, torch.tensor([torch.pi / 2]).double())
    beside = scene.pixels + torch.tensor([[[3.0, 4.0]], [[0.0, 0.0]]])
    weights = torch.tensor([[3.0], [4.0]]).double()
    residual = reprojection_residual(scene.views.proj, scene.points, beside, weights)
    assert_close(residual, torch.tensor([3.0]).double())  # sqrt(9 * 25 / 25) px
    lone = point_covariance(scene.views.proj, scene.points, weights * torch.tensor([[1.0], [0]]))
    assert (lone == 0).all()


def test_many_points_are_solved_as_few_are() -> None:
    scene = forward_motion()
    many = scene.pixels.repeat(1, 5000, 1)  # more than one chunk
    mask = torch.rand(many.shape[:-1], generator=torch.Generator().manual_seed(0)) < 0.9
    whole = triangulate(scene.views.proj, many, mask=mask, covariance=True)
    assert whole.points.shape == (many.shape[1], 3)
    for first in (0, 8190, many.shape[1] - 40):
        some = slice(first, first + 40)
        part = triangulate(scene.views.proj, many[:, some], mask=mask[:, some], covariance=True)
        assert torch.equal(whole.status[some], part.status)
        assert_close(whole.points[some], part.points, rtol=1e-9, atol=1e-12)
        assert_close(whole.depth[:, some], part.depth, rtol=1e-9, atol=1e-12)
        assert whole.covariance is not None
        assert part.covariance is not None
        assert_close(whole.covariance[some], part.covariance, rtol=1e-6, atol=1e-12)


@given(drawn=noisy())
def test_no_weights_are_equal_weights(drawn: tuple[PosedScene, Tensor]) -> None:
    scene, weights = drawn
    alone = triangulate_points(scene.views.proj, scene.pixels)
    found = triangulate_points(scene.views.proj, scene.pixels, torch.full_like(weights, 0.3))
    assert_close(found, alone, rtol=0, atol=1e-9)


def test_a_covariance_beyond_the_dtype_is_a_covariance_still() -> None:
    scene = forward_motion(dtype=torch.float32)  # whose axes are not those of its covariance
    faint = torch.full(scene.pixels.shape[:-1], 5e-24)
    found = triangulate(scene.views.proj, scene.pixels, faint, covariance=True)
    limit = torch.finfo(torch.float32).max
    assert found.valid.all() and found.covariance is not None
    assert torch.equal(found.covariance, (limit * torch.eye(3)).expand_as(found.covariance))
