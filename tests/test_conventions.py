"""Each convention of the project, pinned by one test."""

import math
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from kornia.geometry.camera import PinholeCamera
from PIL import Image
from torch.testing import assert_close

from deltas_geom import (
    PosedViews,
    Status,
    camera_centers,
    epipolar_segments,
    in_image,
    normalize_pixels,
    pixel_grid,
    project,
    rasterize_depth,
    resize_pixels,
    sample_inv_depths,
    sample_map,
    triangulate,
    unproject,
)
from deltas_geom.testing import default_intrinsics, forward_motion, rigid, ring

PAGE = (Path(__file__).parents[1] / "docs" / "conventions.md").read_text()
OPENCV, NERF, DLT = re.findall(r"^```python\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)
IDENTITY = PosedViews(default_intrinsics()[None], torch.eye(4).double()[None])


def test_x_is_right_y_is_down_z_is_forward() -> None:
    right, down = torch.tensor([[0.1, 0.0, 1.0], [0.0, 0.1, 1.0]]).double()
    pixels = project(IDENTITY, torch.stack([right, down])).pixels[0]
    assert_close(pixels, torch.tensor([[370.0, 240.0], [320.0, 290.0]]).double())


def test_poses_are_cam_from_world_in_metres() -> None:
    pose = rigid(torch.zeros(3), torch.tensor([-0.2, 0.0, 0.0])).double()
    assert_close(camera_centers(pose), torch.tensor([0.2, 0, 0]).double())


def test_depth_is_along_z_and_not_along_the_ray() -> None:
    corner = unproject(IDENTITY, torch.zeros(1, 1, 2).double(), torch.full((1, 1), 2.0).double())
    assert corner[0, 0, 2] == 2 and corner.norm() > 2.4
    assert project(IDENTITY, corner[0]).depth.item() == 2


def test_a_pixel_is_x_then_y_and_an_image_size_height_then_width() -> None:
    assert pixel_grid((2, 3))[-1].tolist() == [2, 1]
    assert in_image(torch.tensor([2.0, 1.0]), image_size=(2, 3))
    assert not in_image(torch.tensor([1.0, 2.0]), image_size=(2, 3))


def test_the_image_spans_half_a_pixel_beyond_the_outer_centres() -> None:
    edges = torch.tensor([[-0.5, -0.5], [2.5, 1.5], [-0.51, 0], [2.51, 0]])
    assert in_image(edges, image_size=(2, 3)).tolist() == [True, True, False, False]


def test_grid_sample_without_aligned_corners_reads_pixel_centres() -> None:
    image = torch.arange(12.0).reshape(1, 1, 3, 4)
    grid = normalize_pixels(pixel_grid((3, 4)), image_size=(3, 4)).reshape(1, 3, 4, 2)
    assert_close(F.grid_sample(image, grid, align_corners=False), image)


@pytest.mark.parametrize("new_size", [(6, 20), (12, 10), (48, 80)])
def test_pillow_resizes_by_our_rule(new_size: tuple[int, int]) -> None:
    old_size = (24, 40)
    x, y = pixel_grid(old_size).unbind(dim=-1)
    ramp = (3 * x + 2 * y + 5).reshape(old_size)
    resized = Image.fromarray(ramp.numpy()).resize(new_size[::-1], Image.Resampling.BOX)
    if new_size[0] > old_size[0]:
        resized = Image.fromarray(ramp.numpy()).resize(new_size[::-1], Image.Resampling.BILINEAR)
    # What the new image shows at a pixel is what the old one shows where that pixel was.
    before = resize_pixels(pixel_grid(new_size), old_size=new_size, new_size=old_size)
    inner = in_image(before, image_size=old_size, border=0.5)  # the border is not a ramp
    wanted = 3 * before[:, 0] + 2 * before[:, 1] + 5
    found = torch.from_numpy(np.array(resized)).flatten()
    assert_close(found[inner], wanted[inner], rtol=0, atol=1e-4)  # grey levels


@pytest.mark.parametrize("new_size", [(6, 20), (12, 10), (48, 80)])
def test_scikit_image_resizes_by_our_rule(new_size: tuple[int, int]) -> None:
    transform = pytest.importorskip("skimage.transform")
    old_size = (24, 40)
    x, y = pixel_grid(old_size).unbind(dim=-1)
    ramp = (3 * x + 2 * y + 5).reshape(old_size)
    found = transform.resize(
        ramp.numpy(), new_size, order=1, anti_aliasing=False, preserve_range=True
    )
    before = resize_pixels(pixel_grid(new_size), old_size=new_size, new_size=old_size)
    inner = in_image(before, image_size=old_size, border=0.5)
    wanted = 3 * before[:, 0] + 2 * before[:, 1] + 5
    assert_close(torch.from_numpy(found).float().flatten()[inner], wanted[inner], rtol=0, atol=1e-3)


@pytest.mark.parametrize("size", [(6, 20), (48, 80)])
def test_torch_resizes_by_our_rule(size: tuple[int, int]) -> None:
    x, y = pixel_grid((24, 40)).unbind(dim=-1)
    ramp = (3 * x + 2 * y + 5).reshape(1, 1, 24, 40)
    found = F.interpolate(ramp, size, mode="bilinear", align_corners=False).flatten()
    before = resize_pixels(pixel_grid(size), old_size=size, new_size=(24, 40))
    inner = in_image(before, image_size=(24, 40), border=0.5)
    wanted = 3 * before[:, 0] + 2 * before[:, 1] + 5
    assert_close(found[inner], wanted[inner], rtol=0, atol=1e-3)


def test_a_feature_map_of_stride_r_is_read_at_p_plus_half_over_r_minus_half() -> None:
    stride, pixel = 8, torch.tensor([[21.0, 10.0]])
    columns = torch.arange(6.0).expand(1, 4, 6)
    read = sample_map(columns, pixel, image_size=(32, 48))
    assert_close(read[0, 0], (pixel[0, 0] + 0.5) / stride - 0.5)


def test_true_in_a_mask_means_used() -> None:
    scene = forward_motion()
    mask = torch.tensor([[True, True, False], [True, True, True]])
    valid = triangulate(scene.views.proj, scene.pixels, mask=mask).valid
    assert valid.tolist() == [True, True, False]
    sparse = rasterize_depth(
        torch.zeros(2, 2),
        torch.tensor([1.0, 2.0]),
        image_size=(1, 1),
        mask=torch.tensor([False, True]),
    )
    assert sparse.depth.item() == 2


def test_view_0_is_the_anchor_and_inverse_depths_are_its_own() -> None:
    scene = forward_motion()
    anchor_depth = project(scene.views, scene.points).depth[0]
    samples = sample_inv_depths(
        scene.views, scene.pixels[0], 1 / anchor_depth[:, None], image_size=(480, 640)
    )
    assert_close(samples.pixels[0, :, 0, 0], scene.pixels[1], rtol=0, atol=1e-9)  # px


def test_a_segment_starts_far_away() -> None:
    scene = forward_motion()
    segments = epipolar_segments(
        scene.views, scene.pixels[0], depth_range=(1, 10), image_size=(480, 640)
    )
    assert (segments.inv_depth_start < segments.inv_depth_end).all()


def test_failure_is_data(dtype: torch.dtype) -> None:
    pixels = torch.full((2, 1, 2), torch.nan, dtype=dtype)
    result = triangulate(forward_motion(dtype=dtype).views.proj, pixels)
    assert result.status.item() == Status.NOT_FINITE_INPUT
    assert result.points.tolist() == [[0, 0, 0]]


def test_kornia_cameras_project_and_unproject_as_ours_do() -> None:
    K = torch.tensor([[[500.0, 0, 300], [0, 450, 200], [0, 0, 1]]]).double()
    pose = rigid(
        torch.tensor([[0.1, -0.2, 0.3]]).double(), torch.tensor([[0.5, -1.0, 2.0]]).double()
    )
    ours = PosedViews(K, pose)
    theirs = ours.to_kornia(image_size=(400, 600))
    assert isinstance(theirs, PinholeCamera)
    points = torch.tensor([[0.3, 0.2, 4.0], [-0.5, 1.0, 3.0]]).double()
    seen = project(ours, points)
    assert_close(theirs.project(points[None])[0], seen.pixels[0], rtol=0, atol=1e-6)  # px
    back = theirs.unproject(seen.pixels[0][None], seen.depth[0][None, :, None])[0]
    assert_close(back, points, rtol=0, atol=1e-6)  # m
    assert_close(unproject(ours, seen.pixels, seen.depth)[0], points, rtol=0, atol=1e-12)
    again = PosedViews.from_kornia(theirs)
    assert_close(again.K, K, rtol=0, atol=0)
    assert_close(again.cam_from_world, pose, rtol=0, atol=0)


def test_the_snippet_on_opencv_gives_poses_that_project_as_its_own() -> None:
    names: dict[str, Any] = {}
    exec(compile(OPENCV, "docs/conventions.md", "exec"), names)
    K, points = default_intrinsics(), torch.tensor([[0.3, 0.2, 4.0], [-0.5, 1.0, 3.0]]).double()
    seen = project(PosedViews(K.expand(2, 3, 3), names["cam_from_world"]), points).pixels
    for ours, rvec, tvec in zip(seen, names["rvecs"], names["tvecs"], strict=True):
        theirs, _ = names["cv2"].projectPoints(points.numpy(), rvec, tvec, K.numpy(), None)
        assert_close(ours, torch.from_numpy(theirs[:, 0]), rtol=0, atol=1e-9)  # px


def test_the_snippet_on_nerf_looks_along_minus_z_with_the_angle_from_edge_to_edge() -> None:
    names: dict[str, object] = {}
    exec(compile(NERF, "docs/conventions.md", "exec"), names)
    views, width, height = names["views"], 800, 600
    assert isinstance(views, PosedViews) and views.num_views == 5
    side = math.tan(0.6911 / 2)
    corner = torch.tensor([[side, side * height / width, -1.0]])  # right, up and ahead in OpenGL
    seen = project(views, torch.cat([corner, corner * torch.tensor([-1.0, -1, 1])])).pixels[0]
    wanted = torch.tensor([[width - 0.5, -0.5], [-0.5, height - 0.5]])
    assert_close(seen, wanted, rtol=0, atol=1e-3)  # px


def test_the_line_on_projections_up_to_scale_gives_K_R_t() -> None:
    scene = ring()
    scales = torch.tensor([2.0, 0.5, 3.0, 0.1]).double()[:, None, None]
    names = {"proj": scene.views.proj * scales * torch.tensor([1, -1]).repeat(2)[:, None, None]}
    exec(compile(DLT, "docs/conventions.md", "exec"), names)
    assert_close(names["proj"], scene.views.proj, rtol=1e-12, atol=1e-9)
    # What the page says that scales do, and a sign.
    shifted = scene.pixels + torch.arange(8).reshape(4, 1, 2)
    weights = torch.ones(scene.pixels.shape[:-1]).double()
    plain = triangulate(scene.views.proj, shifted, weights).points
    weighted = triangulate(scene.views.proj, shifted, weights * scales[..., 0]).points
    scaled = triangulate(scene.views.proj * scales, shifted, weights)
    # As a weight but for the frame in which the equations are solved.
    assert (scaled.points - weighted).norm() < 0.1 * (plain - weighted).norm()
    assert_close(scaled.depth, scales[..., 0] * project(scene.views, scaled.points).depth)
    behind = triangulate(-scene.views.proj, scene.pixels)
    assert (behind.status == Status.BEHIND_CAMERA).all()


def test_the_line_on_lens_distortion_gives_the_pixels_of_a_pinhole() -> None:
    (line,) = re.findall(r"`(cv2\.undistortPoints\(.*?\))`", PAGE)
    scene, dist = forward_motion(), np.array([-0.1, 0.02, 1e-3, -1e-3])
    K, pose = scene.views.K[0].numpy(), scene.views.cam_from_world[0].numpy()
    turn, _ = cv2.Rodrigues(pose[:3, :3])
    pixels, _ = cv2.projectPoints(scene.points.numpy(), turn, pose[:3, 3], K, dist)
    wanted = scene.pixels[0].numpy()
    assert np.abs(pixels[:, 0] - wanted).max() > 1
    straight = eval(line, {"cv2": cv2, "pixels": pixels, "K": K, "dist": dist})
    np.testing.assert_allclose(straight[:, 0], wanted, rtol=0, atol=0.01)  # px
