"""Posed views and the conversions users need most."""

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from kornia.geometry.camera import PinholeCamera
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import PosedViews, ShapeError, invert_pose, project
from deltas_geom.testing import PosedScene, default_intrinsics, forward_motion, ring
from deltas_geom.testing.strategies import posed_scenes


def test_views_need_one_pose_for_each_camera() -> None:
    K = default_intrinsics().expand(2, 3, 3)
    with pytest.raises(ShapeError, match="cam_from_world has V = 3 but K has V = 2"):
        _ = PosedViews(K, torch.eye(4).expand(3, 4, 4)).proj


LOOKS: dict[str, Callable[[PosedViews], Any]] = {
    "proj": lambda views: views.proj,
    "num_views": lambda views: views.num_views,
    "select": lambda views: views.select(0),
    "check_values": lambda views: views.check_values(),
    "check_shapes": lambda views: views.check_shapes(),
    "to_kornia": lambda views: views.to_kornia(image_size=(480, 640)),
    "from_opengl": lambda views: PosedViews.from_opengl(*views),
    "from_world_from_cam": lambda views: PosedViews.from_world_from_cam(*views),
}


@pytest.mark.parametrize("name", LOOKS)
@pytest.mark.parametrize(
    ("K", "poses"),
    [((), (5,)), ((1,), (5,)), ((), (2, 5)), ((2, 1), (2, 5)), ((2,), (2, 5))],
    ids=["3 3", "1 3 3", "3 3 of a batch", "2 1 3 3", "one of each scene"],
)
def test_one_K_for_all_views_is_an_error_that_mends_itself(
    name: str, K: tuple[int, ...], poses: tuple[int, ...]
) -> None:
    one = default_intrinsics().expand(*K, 3, 3)
    cam_from_world = torch.eye(4).double().expand(*poses, 4, 4)
    with pytest.raises(ShapeError, match="for one K of all views pass K") as error:
        LOOKS[name](PosedViews(one, cam_from_world))
    assert str(error.value).startswith("K must have shape (*B, 5, 3, 3)")
    mended = eval(str(error.value).split(" pass ")[1], {"K": one})
    LOOKS[name](PosedViews(mended, cam_from_world))


@pytest.mark.parametrize("name", LOOKS)
def test_views_that_do_not_go_together_are_named(name: str) -> None:
    K, poses = default_intrinsics().expand(5, 3, 3), torch.eye(4).expand(5, 4, 4)
    pose = "world_from_cam" if name.startswith("from") else "cam_from_world"
    for views, reason in (
        (PosedViews(K[:2], poses), f"{pose} has V = 5 but K has V = 2"),
        (PosedViews(K, poses[0]), rf"{pose} must have shape \(\*B, V, 4, 4\), got \(4, 4\)"),
        (PosedViews(K, poses[:, :3]), rf"{pose} must have shape .* got \(5, 3, 4\)"),
        (PosedViews(poses, poses), r"K must have shape \(\*B, V, 3, 3\), got \(5, 4, 4\)"),
        (PosedViews(K.expand(3, 5, 3, 3), poses.expand(2, 5, 4, 4)), r"broadcast, .*3.*2"),
    ):
        with pytest.raises(ShapeError, match=reason):
            LOOKS[name](views)
    with pytest.raises(TypeError, match=r"cam_from_world must be a torch\.Tensor, got ndarray"):
        LOOKS[name](PosedViews(K, poses.numpy()))
    with pytest.raises(TypeError, match=r"K must be a torch\.Tensor, got ndarray"):
        LOOKS[name](PosedViews(K.numpy(), poses))


@given(scene=posed_scenes())
def test_camera_to_world_poses_give_the_same_cameras(scene: PosedScene) -> None:
    views = PosedViews.from_world_from_cam(scene.views.K, invert_pose(scene.views.cam_from_world))
    assert_close(views.proj, scene.views.proj, rtol=0, atol=1e-10)


@given(scene=posed_scenes())
def test_opengl_cameras_look_along_minus_z_with_y_up(scene: PosedScene) -> None:
    opencv = invert_pose(scene.views.cam_from_world)
    right, down, forward, position = opencv.unbind(dim=-1)
    opengl = torch.stack([right, -down, -forward, position], dim=-1)
    views = PosedViews.from_opengl(scene.views.K, opengl)
    assert_close(views.proj, scene.views.proj, rtol=0, atol=1e-10)


@given(scene=posed_scenes(num_views=3))
def test_selected_views_see_what_they_saw(scene: PosedScene) -> None:
    for chosen in (1, slice(1, 3), [2, 0]):
        pixels = project(scene.views.select(chosen), scene.points).pixels
        index = [chosen] if isinstance(chosen, int) else chosen
        assert_close(pixels, scene.pixels[index], rtol=0, atol=0)


@pytest.mark.parametrize("index", [np.int64(1), torch.tensor(1), np.array(1), -3], ids=repr)
def test_an_integer_of_any_kind_keeps_the_view_dim(index: Any) -> None:
    views = ring().views
    found = views.select(index)
    assert found.num_views == 1 and (found.proj[0] == views.proj[1]).all()


@pytest.mark.parametrize("index", [np.array([1]), torch.tensor([1]), (1,)], ids=repr)
def test_a_list_of_one_keeps_the_view_dim(index: Any) -> None:
    assert ring().views.select(index).proj.shape == (1, 3, 4)


def test_good_values_pass_and_bad_ones_say_why() -> None:
    views = forward_motion().views
    views.check_values()
    for K, reason in (
        (views.K * torch.nan, "finite"),
        (-views.K, "positive focal"),
        (views.K.mT.contiguous(), "upper triangular"),
        (2 * views.K, r"K\[2, 2\] = 1"),
    ):
        with pytest.raises(ValueError, match=reason):
            PosedViews(K, views.cam_from_world).check_values()
    for row, factor, reason in (
        (slice(3, 4), 2.0, "last row 0 0 0 1"),
        (slice(0, 1), -1.0, "no mirror"),
        (slice(0, 3), 1.3, "no scale"),
        (slice(0, 3), torch.nan, "finite"),
    ):
        poses = views.cam_from_world.clone()
        poses[1, row] *= factor
        with pytest.raises(ValueError, match=f"{reason}: not so in view 1"):
            PosedViews(views.K, poses).check_values()


def test_a_scale_in_camera_to_world_rotations_is_found_and_is_one_of_depths() -> None:
    scene = ring()
    world_from_cam = invert_pose(scene.views.cam_from_world)
    world_from_cam[..., :3, :3] *= 1.3
    views = PosedViews.from_world_from_cam(scene.views.K, world_from_cam)
    wrong, right = (project(v, scene.points).depth for v in (views, scene.views))
    assert_close(wrong, 1.3 * right)
    for read in (PosedViews.from_world_from_cam, PosedViews.from_opengl):
        with pytest.raises(ValueError, match="rigid"):
            read(scene.views.K, world_from_cam).check_values()


@given(scene=posed_scenes(num_views=3))
def test_kornia_gets_and_gives_back_the_same_cameras(scene: PosedScene) -> None:
    camera = scene.views.to_kornia(image_size=(480, 640))
    assert camera.height.tolist() == [480] * 3 and camera.width.tolist() == [640] * 3
    back = PosedViews.from_kornia(camera)
    assert_close(back.proj, scene.views.proj, rtol=0, atol=0)


def test_a_kornia_batch_is_split_into_views() -> None:
    views = ring().views
    batch = PosedViews(views.K.expand(3, 4, 3, 3), views.cam_from_world.expand(3, 4, 4, 4))
    camera = batch.to_kornia(image_size=(480, 640))
    assert PosedViews.from_kornia(camera, num_views=4).proj.shape == (3, 4, 3, 4)
    with pytest.raises(ShapeError, match="12 kornia cameras are no multiple of num_views=5"):
        PosedViews.from_kornia(camera, num_views=5)
    with pytest.raises(ShapeError, match="got a kornia camera of none"):
        PosedViews.from_kornia(_without_cameras())
    assert PosedViews.from_kornia(_without_cameras(), num_views=2).proj.shape == (0, 2, 3, 4)


def _without_cameras() -> PinholeCamera:
    return PinholeCamera(*(torch.zeros(0, 4, 4),) * 2, *(torch.zeros(0),) * 2)


@pytest.mark.parametrize("num_views", [0, -2, -5])
def test_a_kornia_batch_is_not_split_into_less_than_a_view(num_views: int) -> None:
    camera = ring().views.to_kornia(image_size=(480, 640))
    with pytest.raises(
        ValueError,
        match=re.escape(f"num_views must be at least 1, or None for all, got {num_views}"),
    ):
        PosedViews.from_kornia(camera, num_views=num_views)


def in_kornia(views: PosedViews) -> Tensor:
    camera = views.to_kornia(image_size=(480, 640))
    back: Tensor = PosedViews.from_kornia(camera).proj
    return back


def test_kornia_gets_what_broadcasts_and_promotes() -> None:
    views = ring().views
    moved = views.cam_from_world.repeat(3, 1, 1, 1)
    moved[1, :, 0, 3] += 1.0
    batch = PosedViews(views.K, moved)
    assert_close(in_kornia(batch), batch.proj.flatten(0, 1), rtol=0, atol=0)
    batch = PosedViews(views.K.expand(3, 4, 3, 3), views.cam_from_world)
    assert_close(in_kornia(batch), batch.proj.flatten(0, 1), rtol=0, atol=0)
    for mixed in (
        PosedViews(views.K, views.cam_from_world.float()),
        PosedViews(views.K.float(), views.cam_from_world),
    ):
        assert mixed.proj.dtype == torch.float64
        assert_close(in_kornia(mixed), mixed.proj, rtol=0, atol=0)
