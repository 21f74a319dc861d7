"""Weighted, masked n-view triangulation: its invariants, and its answer against other solvers."""

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from kornia.geometry.epipolar import triangulate_points as kornia_triangulate
from torch import Tensor
from torch.testing import assert_close
from triangulation_cases import noisy, svd_points

from deltas_geom import (
    PosedViews,
    Status,
    camera_centers,
    point_covariance,
    project,
    ray_parallax,
    reprojection_residual,
    triangulate,
    triangulate_points,
)
from deltas_geom.testing import (
    PosedScene,
    default_intrinsics,
    forward_motion,
    right_angle,
    rigid,
    ring,
)
from deltas_geom.testing.strategies import scales

pytestmark = pytest.mark.usefixtures("way")


def test_wrong_arguments_are_named() -> None:
    proj, pixels = torch.zeros(2, 3, 4), torch.zeros(2, 5, 2)
    with pytest.raises(ValueError, match="frame must be 'rig' or 'world', got 'rigid'"):
        triangulate(proj, pixels, frame="rigid")


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


@given(drawn=noisy())
@pytest.mark.parametrize("frame", ["rig", "world"])
def test_the_answer_is_that_of_an_svd(frame: str, drawn: tuple[PosedScene, Tensor]) -> None:
    scene, weights = drawn
    proj = scene.views.proj
    ours = triangulate_points(proj, scene.pixels, weights, frame=frame)
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


def test_second_derivatives_are_right_off_the_ties() -> None:
    scene = right_angle()

    def solve(pixels: Tensor) -> Tensor:
        return triangulate_points(scene.views.proj, pixels)

    pixels = (scene.pixels + torch.tensor([3.0, -2.0])).requires_grad_()
    assert torch.autograd.gradgradcheck(solve, (pixels,), eps=1e-3, atol=1e-6)


@pytest.mark.parametrize("scene", [right_angle(), ring()], ids=["90 degrees", "ring"])
def test_at_exact_ties_svd_has_no_gradient(scene: PosedScene) -> None:
    pixels = scene.pixels.clone().requires_grad_()
    weights = torch.ones_like(scene.pixels[..., 0])
    by_svd = torch.autograd.grad(svd_points(scene.views.proj, pixels, weights).sum(), pixels)[0]
    assert by_svd.isnan().any()
    ours = torch.autograd.grad(triangulate_points(scene.views.proj, pixels).sum(), pixels)[0]
    assert ours.isfinite().all() and (ours != 0).any()


def test_a_singular_camera_that_is_masked_spoils_no_gradient() -> None:
    scene = ring()
    proj = scene.views.proj.clone()
    proj[3] = 0
    proj.requires_grad_()
    mask = torch.tensor([True, True, True, False])[:, None]
    points = triangulate_points(proj, scene.pixels, mask=mask)
    assert_close(points, scene.points, rtol=0, atol=1e-12)  # m
    assert torch.autograd.grad(points.sum(), proj)[0].isfinite().all()


def test_unequal_weights_do_not_send_a_near_point_to_infinity(dtype: torch.dtype) -> None:
    scene = forward_motion(dtype=dtype)
    weights = torch.tensor([[1.0], [1e-5]], dtype=dtype).expand(2, 3)
    result = triangulate(scene.views.proj, scene.pixels, weights)
    assert (result.status == Status.OK).all()
    assert_close(result.points, scene.points, rtol=0, atol=1e-4)  # m


def test_two_cameras_in_one_place_have_no_baseline_wherever_the_others_stand() -> None:
    turn = torch.tensor([[0.0, 0, 0], [0, 0.1, 0], [0, 0, 0], [0.1, 0, 0], [0, 0, 0.1]]).double()
    centers = torch.tensor([[3.0, 0, 0], [3, 0, 0], [0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]]).double()
    pose = rigid(turn, torch.zeros(5, 3).double())
    pose[:, :3, 3:] = -pose[:, :3, :3] @ centers[..., None]
    views = PosedViews(default_intrinsics().expand(5, 3, 3).double(), pose)
    points = torch.tensor([[0.2, 0.1, 5.0], [1.0, -0.3, 8.0]]).double()
    off = torch.tensor([[0.0, 0.0], [0.5, -0.5]]).double()
    pixels = project(views, points).pixels + off[:, None].repeat(3, 1, 1)[:5]
    mask = torch.tensor([True, True, False, False, False])[:, None].expand(5, 2)
    found = triangulate(views.proj, pixels, mask=mask)
    assert (found.status == Status.NO_PARALLAX).all()


def test_behind_one_camera_of_three_is_behind() -> None:
    pose = torch.eye(4).double().repeat(3, 1, 1)
    pose[1, 0, 3] = -0.3
    pose[2] = torch.diag(torch.tensor([-1.0, 1, -1, 1]))  # looks back, from 1 m ahead
    pose[2, 2, 3] = 1.0
    proj = default_intrinsics().double() @ pose[:, :3]
    points = torch.tensor([[0.1, 0.2, 3.0, 1.0], [0.1, 0.2, 0.5, 1.0]]).double()
    seen = points @ proj.mT  # a line through the centre meets the image's plane on either side
    found = triangulate(proj, seen[..., :2] / seen[..., 2:])
    assert found.status.tolist() == [Status.BEHIND_CAMERA, Status.OK]


def test_every_status_explains_itself() -> None:
    for status in Status:
        assert len(status.explanation.split()) >= 4
    assert np.unique([status.explanation for status in Status]).size == len(Status)
