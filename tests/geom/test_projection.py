"""World points to pixels and back."""

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from kornia.geometry.camera import project_points
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import PosedViews, ShapeError, pixel_rays, project, unproject
from deltas_geom.testing import PosedScene, forward_motion, rigid
from deltas_geom.testing.invariants import INVARIANTS, World
from deltas_geom.testing.strategies import extreme, posed_scenes, scales, vectors
from deltas_geom.testing.targets import deltas

OURS = deltas()
EXACT = ["pixels_are_those_of_the_camera_equations", "pixels_follow_a_crop_and_a_resize"]


def test_wrong_shapes_are_named() -> None:
    views = forward_motion().views
    with pytest.raises(ShapeError, match=r"points must have shape \(\*B, N, 3\), got \(3, 2\)"):
        project(views, torch.zeros(3, 2))
    with pytest.raises(ShapeError, match="depth has V = 1"):
        unproject(views, torch.zeros(2, 5, 2), torch.zeros(1, 5))
    three = PosedViews(views.K.expand(3, 2, 3, 3), views.cam_from_world)
    with pytest.raises(ShapeError, match=r"must broadcast, got \(3,\), \(2,\), \(\)"):
        unproject(three, torch.zeros(2, 2, 5, 2), torch.zeros(2, 5))
    with pytest.raises(ShapeError, match=r"must broadcast, got \(3,\), \(\), \(2,\)"):
        unproject(three, torch.zeros(2, 5, 2), torch.zeros(2, 2, 5))
    with pytest.raises(ShapeError, match=r"must broadcast, got \(3,\), \(2,\)"):
        pixel_rays(three.K[:, 0], torch.zeros(2, 5, 2))


@given(scene=posed_scenes(num_views=3))
def test_unprojection_undoes_projection(scene: PosedScene) -> None:
    seen = project(scene.views, scene.points)
    back = unproject(scene.views, seen.pixels, seen.depth)
    assert_close(back, scene.points.expand_as(back), rtol=0, atol=1e-12)  # m


@given(scene=posed_scenes())
@pytest.mark.parametrize("name", EXACT)
def test_pixels_are_exact(name: str, scene: PosedScene) -> None:
    INVARIANTS[name](OURS, scene, tolerance=1e-8)  # px


@given(
    scene=posed_scenes(),
    turn=vectors(1, within=3.0),
    shift=vectors(1, within=100.0),
    scale=scales(decades=2),
)
def test_pixels_do_not_know_the_worlds_origin_axes_or_unit(
    scene: PosedScene, turn: Tensor, shift: Tensor, scale: float
) -> None:
    world = World(rigid(turn, shift)[0], scale)
    INVARIANTS["pixels_do_not_know_the_worlds_frame"](OURS, scene, world=world, tolerance=1e-8)
    depth = project(world.views(scene.views), world.points(scene.points)).depth
    assert_close(depth, scale * project(scene.views, scene.points).depth, rtol=1e-9, atol=0)


@given(scene=posed_scenes(), depth=st.floats(-5, 5))
def test_in_front_is_a_positive_depth(scene: PosedScene, depth: float) -> None:
    ahead = unproject(scene.views, scene.pixels, torch.full((2, 4), depth, dtype=torch.float64))
    seen = project(scene.views.select(0), ahead[0])
    if abs(depth) > 1e-9:
        assert (seen.in_front == (depth > 0)).all()
    assert ((seen.pixels == 0).all(dim=-1) | seen.in_front).all()


@given(scene=posed_scenes())
def test_float32_is_within_its_bound_of_float64(scene: PosedScene) -> None:
    single = scene.views.to(torch.float32)
    seen = project(single, scene.points.float()).pixels.double()
    exact = project(single.to(torch.float64), scene.points.float().double()).pixels
    # 24 roundings of terms up to 1000 px at a depth above 1.8 m.
    assert_close(seen, exact, rtol=0, atol=24 * 6e-8 * 4000)  # px


@given(points=extreme(4, 3))
def test_no_finite_point_gives_nan_or_inf(points: Tensor) -> None:
    for dtype in (torch.float32, torch.float64):
        views = forward_motion(dtype=dtype).views
        K = views.K.clone().requires_grad_()
        given_points = points.to(dtype).requires_grad_()
        seen = project(PosedViews(K, views.cam_from_world), given_points)
        assert seen.pixels.isfinite().all() and seen.depth.isfinite().all()
        for gradient in torch.autograd.grad(seen.pixels.sum(), (given_points, K)):
            assert gradient.isfinite().all()


@given(scene=posed_scenes())
def test_opencv_projects_alike(scene: PosedScene) -> None:
    for view in range(2):
        pose = scene.views.cam_from_world[view].numpy()
        K = scene.views.K[view].numpy().copy()
        K[0, 1] = 0  # OpenCV has no skew
        turn, _ = cv2.Rodrigues(pose[:3, :3])
        theirs, _ = cv2.projectPoints(scene.points.numpy(), turn, pose[:3, 3], K, np.zeros(4))
        views = PosedViews(torch.from_numpy(K)[None], scene.views.cam_from_world[view][None])
        ours = project(views, scene.points).pixels[0]
        assert_close(ours, torch.from_numpy(theirs[:, 0]), rtol=0, atol=1e-9)  # px


@given(scene=posed_scenes())
def test_kornia_projects_alike(scene: PosedScene) -> None:
    K = scene.views.K.clone()
    K[:, 0, 1] = 0  # kornia's has no skew
    views = PosedViews(K, scene.views.cam_from_world)
    rotation, translation = views.cam_from_world[:, :3, :3], views.cam_from_world[:, None, :3, 3]
    in_camera = scene.points @ rotation.mT + translation
    theirs = project_points(in_camera, K[:, None].expand(2, 4, 3, 3))
    assert_close(project(views, scene.points).pixels, theirs, rtol=0, atol=1e-6)  # px


def test_gradients_are_right() -> None:
    scene = forward_motion()
    K, pose = scene.views.K.clone().requires_grad_(), scene.views.cam_from_world.clone()
    points = scene.points.clone().requires_grad_()

    def pixels(K: Tensor, points: Tensor) -> Tensor:
        return project(PosedViews(K, pose), points).pixels

    def back(K: Tensor, pixels: Tensor) -> Tensor:
        return unproject(PosedViews(K, pose), pixels, pixels[..., 0] / 100)

    assert torch.autograd.gradcheck(pixels, (K, points))
    assert torch.autograd.gradcheck(back, (K, scene.pixels.clone().requires_grad_()))


def test_a_ray_through_the_principal_point_looks_ahead() -> None:
    K = forward_motion().views.K
    assert_close(pixel_rays(K, K[:, None, :2, 2]), torch.tensor([[[0.0, 0, 1]]] * 2).double())


def test_a_point_that_is_nan_behind_or_in_the_camera_has_no_pixel_and_no_gradient() -> None:
    views = forward_motion().views
    K = views.K.clone().requires_grad_()
    points = torch.tensor([[0.0, 0, -1], [1, 1, 0], [torch.nan, 0, 1], [0, torch.inf, 1]]).double()
    points.requires_grad_()
    seen = project(PosedViews(K, views.cam_from_world).select(0), points)
    assert not seen.in_front.any() and (seen.pixels == 0).all() and seen.depth.isfinite().all()
    for gradient in torch.autograd.grad(seen.pixels.sum(), (points, K)):
        assert (gradient == 0).all()
