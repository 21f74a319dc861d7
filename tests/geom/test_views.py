"""Posed views and the conversions users need most."""

import pytest
import torch
from hypothesis import given
from torch.testing import assert_close

from deltas_geom import PosedViews, ShapeError, invert_pose, project
from deltas_geom.testing import PosedScene, default_intrinsics, forward_motion, ring
from deltas_geom.testing.strategies import posed_scenes


def test_views_need_one_pose_for_each_camera() -> None:
    K = default_intrinsics().expand(2, 3, 3)
    with pytest.raises(ShapeError, match="cam_from_world has V = 3 but K has V = 2"):
        _ = PosedViews(K, torch.eye(4).expand(3, 4, 4)).proj


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


def test_a_cast_casts_both(dtype: torch.dtype) -> None:
    views = ring().views.to(dtype)
    assert views.K.dtype == views.cam_from_world.dtype == dtype and views.num_views == 4


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
    with pytest.raises(ValueError, match="rigid"):
        PosedViews(views.K, 2 * views.cam_from_world).check_values()


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
