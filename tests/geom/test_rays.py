"""Triangulation of bearing rays of any camera model."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.geometry.calibration import distort_points, undistort_points
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import (
    ShapeError,
    Status,
    camera_centers,
    invert_pose,
    pixel_rays,
    to_homogeneous,
    triangulate,
    triangulate_rays,
)
from deltas_geom.testing import (
    DEGENERATE_SCENES,
    PosedScene,
    default_intrinsics,
    forward_motion,
    right_angle,
    rigid,
    ring,
)
from deltas_geom.testing.strategies import extreme, posed_scenes, scales, vectors


def rays_of(scene: PosedScene) -> Tensor:
    return pixel_rays(scene.views.K, scene.pixels)


@st.composite
def surrounded(draw: st.DrawFn, num_views: int = 3) -> tuple[Tensor, Tensor]:
    """Cameras turned any way, 0.5 m apart, and points 2 m or more away on any side."""
    turn, shift = draw(vectors(num_views, within=3.0)), draw(vectors(num_views, within=0.1))
    corners = torch.tensor([[0.0, 0, 0], [0.5, 0, 0], [0, 0.5, 0], [0, 0, 0.5]]).double()
    world_from_cam = rigid(turn, corners[:num_views] + shift)
    sides = torch.tensor([[1.0, 1, 1], [-1, 1, 1], [1, -1, 1], [-1, -1, -1], [-1, 1, -1]]).double()
    return invert_pose(world_from_cam), 2.5 * sides + draw(vectors(5, within=0.5))


def rays_to(cam_from_world: Tensor, points: Tensor) -> Tensor:
    """In each camera's frame, of no particular length."""
    return to_homogeneous(points) @ cam_from_world[..., :3, :].mT


def noisy(rays: Tensor, noise: Tensor) -> Tensor:
    return rays / rays.norm(dim=-1, keepdim=True) + noise


def test_wrong_arguments_are_named() -> None:
    with pytest.raises(ShapeError, match="rays has V = 3 but cam_from_world has V = 2"):
        triangulate_rays(torch.eye(4).expand(2, 4, 4), torch.zeros(3, 5, 3))
    with pytest.raises(ShapeError, match="weights has N = 4 but rays has N = 5"):
        triangulate_rays(torch.eye(4).expand(2, 4, 4), torch.zeros(2, 5, 3), torch.ones(2, 4))


def test_batch_dims_broadcast(dtype: torch.dtype) -> None:
    scene = forward_motion(dtype=dtype)
    rays = rays_of(scene).expand(4, 1, 2, 3, 3)
    result = triangulate_rays(scene.views.cam_from_world, rays, torch.ones(5, 2, 3, dtype=dtype))
    assert result.points.shape == (4, 5, 3, 3) and result.points.dtype == dtype
    assert result.depth.shape == (4, 5, 2, 3) and result.status.dtype == torch.int8
    assert result.status.shape == result.residual.shape == result.parallax.shape == (4, 5, 3)
    none = triangulate_rays(scene.views.cam_from_world, rays_of(scene)[:, :0])
    assert none.points.shape == (0, 3)


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


@given(drawn=surrounded())
def test_rays_may_point_anywhere(drawn: tuple[Tensor, Tensor]) -> None:
    cam_from_world, points = drawn
    result = triangulate_rays(cam_from_world, rays_to(cam_from_world, points))
    assert result.valid.all()
    assert_close(result.points, points, rtol=0, atol=1e-9)  # m


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


@given(
    drawn=surrounded(),
    noise=vectors(15, within=2e-3),
    turn=vectors(1, within=3.0),
    shift=vectors(1, within=10.0),
    scale=scales(decades=2),
)
def test_points_move_with_the_world(
    drawn: tuple[Tensor, Tensor], noise: Tensor, turn: Tensor, shift: Tensor, scale: float
) -> None:
    cam_from_world, points = drawn
    rays = noisy(rays_to(cam_from_world, points), noise.reshape(3, 5, 3))
    new_from_world = rigid(turn, shift)[0]
    cam_from_new = cam_from_world @ invert_pose(new_from_world)
    cam_from_new[:, :3, 3] *= scale
    here = triangulate_rays(cam_from_world, rays)
    there = triangulate_rays(cam_from_new, rays)
    wanted = scale * (here.points @ new_from_world[:3, :3].mT + new_from_world[:3, 3])
    assert_close(there.points, wanted, rtol=0, atol=1e-8 * scale)
    assert_close(there.residual, here.residual, rtol=0, atol=1e-10)  # rad


@given(drawn=surrounded(), noise=vectors(15, within=2e-3), view=st.integers(0, 2))
def test_a_view_that_is_masked_or_of_weight_0_is_a_view_removed(
    drawn: tuple[Tensor, Tensor], noise: Tensor, view: int
) -> None:
    cam_from_world, points = drawn
    rays = noisy(rays_to(cam_from_world, points), noise.reshape(3, 5, 3))
    rest = [other for other in range(3) if other != view]
    wanted = triangulate_rays(cam_from_world[rest], rays[rest])
    poses = cam_from_world.clone()
    poses[view] = torch.nan
    rays[view] = torch.inf
    used = (torch.arange(3) != view)[:, None].expand(3, 5)
    for result in (
        triangulate_rays(poses, rays, mask=used),
        triangulate_rays(poses, rays, 7.0 * used.double()),
    ):
        assert_close(result.points, wanted.points, rtol=0, atol=1e-10)  # m
        assert_close(result.residual, wanted.residual, rtol=0, atol=1e-10)  # rad
        assert_close(result.depth[rest], wanted.depth, rtol=0, atol=1e-10)  # m
        assert torch.equal(result.status, wanted.status)


def test_the_residual_is_an_angle() -> None:
    scene = right_angle()
    rays = rays_of(scene).repeat(1, 2, 1)
    result = triangulate_rays(scene.views.cam_from_world, rays)
    # One ray out of the plane of the two by 0.01 rad: each gives way by half.
    rays[0, 1] = torch.tensor([0.0, math.sin(0.01), math.cos(0.01)])
    result = triangulate_rays(scene.views.cam_from_world, rays)
    assert result.residual[0] < 1e-12
    assert_close(result.residual[1].item(), 0.005, rtol=1e-3, atol=0)


def test_status_tells_the_truth(dtype: torch.dtype) -> None:
    scene = forward_motion(dtype=dtype)
    poses = scene.views.cam_from_world
    rays = rays_of(scene)[:, :1].repeat(1, 7, 1)
    rays[:, 1] = -rays[:, 1]  # the lines meet where they did, behind both
    rays[1, 2] = rays[0, 2]  # a star
    rays[0, 3] = torch.nan
    rays[0, 4] = 0
    rays[:, 5] = torch.tensor([0.0, 0.0, 1.0])  # along the baseline
    mask = torch.ones(2, 7, dtype=torch.bool)
    mask[0, 6] = False
    inputs = [value.clone().requires_grad_() for value in (poses, rays)]
    result = triangulate_rays(*inputs, mask=mask)
    assert [Status(value).name for value in result.status.tolist()] == [
        "OK",
        "BEHIND_CAMERA",
        "AT_INFINITY",
        "NOT_FINITE_INPUT",
        "NOT_FINITE_INPUT",
        "NO_PARALLAX",
        "TOO_FEW_VIEWS",
    ]
    assert (result.points[1:] == 0).all() and (result.depth[:, 1:] == 0).all()
    total = result.points.sum() + result.depth.sum() + result.residual.sum()
    of_pose, of_rays = torch.autograd.grad(total, inputs)
    assert of_pose.isfinite().all() and of_rays.isfinite().all()
    assert (of_rays[:, 1:] == 0).all() and (of_rays[:, 0] != 0).any()


@pytest.mark.parametrize("name", DEGENERATE_SCENES)
def test_named_scenes_have_the_status_of_their_pixels(name: str, dtype: torch.dtype) -> None:
    scene = DEGENERATE_SCENES[name](dtype=dtype)
    rays = rays_of(scene)
    result = triangulate_rays(scene.views.cam_from_world, rays)
    wanted = triangulate(scene.views.proj, scene.pixels)
    # The rays of a point behind a camera point away from it, as its pixels do.
    assert torch.equal(result.status, wanted.status)
    assert_close(result.points, wanted.points, rtol=1e-5, atol=1e-5)  # m


@pytest.mark.parametrize(
    "scene", [forward_motion(), right_angle(), ring()], ids=["fwd", "90", "ring"]
)
def test_gradients_are_right(scene: PosedScene) -> None:
    generator = torch.Generator().manual_seed(0)
    rays = rays_of(scene)
    rays = rays + 1e-2 * torch.randn(rays.shape, generator=generator, dtype=torch.float64)
    inputs = tuple(
        value.clone().requires_grad_() for value in (scene.views.cam_from_world, rays, rays[..., 2])
    )

    def solve(cam_from_world: Tensor, rays: Tensor, weights: Tensor) -> list[Tensor]:
        result = triangulate_rays(cam_from_world, rays, weights)
        return [result.points, result.depth, result.residual]

    assert torch.autograd.gradcheck(solve, inputs, eps=1e-6, atol=1e-6)
    exact = (inputs[0], rays_of(scene).requires_grad_())
    assert torch.autograd.gradcheck(lambda *args: triangulate_rays(*args).points, exact, atol=1e-6)


@given(drawn=surrounded(), noise=vectors(15, within=2e-3))
def test_float32_is_within_its_bound_of_float64(
    drawn: tuple[Tensor, Tensor], noise: Tensor
) -> None:
    cam_from_world, points = drawn
    rays = noisy(rays_to(cam_from_world, points), noise.reshape(3, 5, 3)).float()
    single = triangulate_rays(cam_from_world.float(), rays)
    exact = triangulate_rays(cam_from_world.float().double(), rays.double())
    assert_close(single.points.double(), exact.points, rtol=0, atol=6e-8 * 8)  # m


@given(rays=extreme(3, 4, 3), weights=extreme(3, 4), poses=extreme(3, 4, 4), wild=st.booleans())
def test_no_finite_input_gives_nan_or_inf(
    rays: Tensor, weights: Tensor, poses: Tensor, wild: bool
) -> None:
    for dtype in (torch.float32, torch.float64):
        # True gradients of 1e40 do not fit float32: numbers up to 1e7 there.
        power = 0.25 if dtype == torch.float32 else 1
        inputs = [
            (value.sign() * value.abs() ** power).to(dtype).requires_grad_()
            for value in (poses if wild else ring().views.cam_from_world[:3], rays, weights)
        ]
        result = triangulate_rays(*inputs)
        assert all(value.isfinite().all() for value in result if value is not None)
        total = result.points.sum() + result.depth.sum() + result.residual.sum()
        for gradient in torch.autograd.grad(total, inputs):
            assert gradient.isfinite().all()


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
