"""Samples: the camera follows the image through resizing, the depth follows the camera."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from deltas_geom.cameras.pixels import resize_intrinsics
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.images import resize_image
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.view_sets import read_view_sets
from deltas_nets.captures.work_size import depth_at_image, fit_work_size, load_views

MakeCapture = Callable[..., Path]

sides = st.integers(8, 80)
sizes = st.tuples(sides, sides)


def test_shapes_range_and_types(capture: Capture) -> None:
    frames = [capture.frame(id) for id in (1, 0, 2)]
    images, views = load_views(frames, work_size=(32, 48))
    assert images.shape == (3, 3, 32, 48) and images.dtype == torch.float32
    assert images.min() >= 0 and 0.5 < images.max() <= 1
    assert views.K.shape == (3, 3, 3) and views.cam_from_world.shape == (3, 4, 4)
    assert views.K.dtype == views.cam_from_world.dtype == torch.float32
    assert torch.equal(views.cam_from_world[0], torch.eye(4))
    assert views.cam_from_world[1:, 0, 3].tolist() == pytest.approx([0.15, -0.15])


def test_channels_are_red_green_blue(make_capture: MakeCapture) -> None:
    folder = make_capture()
    Image.new("RGB", (64, 48), (255, 0, 0)).save(folder / "color" / "0.jpg")
    images, _ = load_views([open_capture(folder).frame(0)], work_size=(16, 16))
    assert images[0].mean(dim=(1, 2)).tolist() == pytest.approx([1, 0, 0], abs=0.02)


def test_an_image_at_the_work_size_is_not_touched(capture: Capture) -> None:
    frame = capture.frame(0)
    images, views = load_views([frame], work_size=(48, 64))
    assert np.array_equal(
        (images[0] * 255).round().byte().permute(1, 2, 0).numpy(), frame.read_image()
    )
    assert np.allclose(views.K[0].numpy(), frame.K)


def test_a_distant_origin_costs_nothing(make_capture: MakeCapture, tmp_path: Path) -> None:
    near = open_capture(make_capture(path=tmp_path / "near"))
    far = open_capture(make_capture(path=tmp_path / "far", origin=(4e6, -2e6, 100)))
    for sources in ((0, 1), (2, 3, 1)):
        _, expected = load_views([near.frame(id) for id in sources], work_size=(48, 64))
        _, views = load_views([far.frame(id) for id in sources], work_size=(48, 64))
        # Metres; float32 at 4000 km would be off by 0.25.
        assert (views.cam_from_world - expected.cam_from_world).abs().max() < 1e-6


@settings(deadline=None, max_examples=50)
@given(old_size=sizes, new_size=sizes, place=st.tuples(st.floats(0, 1), st.floats(0, 1)))
def test_a_ray_through_a_pixel_stays_the_same(
    old_size: tuple[int, int], new_size: tuple[int, int], place: tuple[float, float]
) -> None:
    K = torch.tensor([[70.0, 0, 31], [0, 75, 22], [0, 0, 1]], dtype=torch.float64)
    new_K = resize_intrinsics(K, old_size=old_size, new_size=new_size)
    # One place of the scene in both images, as a part of the width and height.
    part = torch.tensor([place[0], place[1]], dtype=torch.float64)
    rays = []
    for matrix, size in ((K, old_size), (new_K, new_size)):
        pixel = part * torch.tensor([size[1], size[0]]) - 0.5
        rays.append(torch.linalg.solve(matrix, torch.cat([pixel, torch.ones(1)]).double()))
    assert (rays[0] - rays[1]).abs().max() < 1e-12


@settings(deadline=None, max_examples=50)
@given(old_width=st.integers(64, 255), ratio=st.floats(0.3, 1.5))
def test_content_moves_as_the_intrinsics_say(old_width: int, ratio: float) -> None:
    new_width = max(16, round(ratio * old_width))
    ramp = np.arange(old_width, dtype=np.uint8)[None, :, None].repeat(8, 0).repeat(3, 2)
    resized = resize_image(ramp, (8, new_width))[4, :, 0].astype(float)
    expected = (np.arange(new_width) + 0.5) * old_width / new_width - 0.5
    border = 4 + int(4 * new_width / old_width)  # where the filter leaves the image
    error = (resized - expected)[border:-border]
    # 0.5 is the rounding to 8 bits; BOX is off by 0.34 more at 540 -> 320.
    assert np.abs(error).max() < 0.56


@settings(deadline=None)
@given(size=st.tuples(st.integers(1, 3000), st.integers(1, 3000)))
def test_work_sizes_are_multiples_within_the_limit(size: tuple[int, int]) -> None:
    height, width = fit_work_size(size, max_pixels=240 * 320)
    assert height % 16 == width % 16 == 0 and height > 0 and width > 0
    assert height * width <= 240 * 320


@pytest.mark.parametrize(
    ("size", "expected"),
    [
        ((480, 640), (240, 320)),
        ((968, 1296), (240, 320)),
        ((360, 540), (224, 336)),
        ((640, 480), (320, 240)),
        ((48, 64), (48, 64)),
        ((1, 1), (16, 16)),
    ],
)
def test_work_sizes_of_common_cameras(size: tuple[int, int], expected: tuple[int, int]) -> None:
    assert fit_work_size(size) == expected


def write_depth(folder: Path, metres: np.ndarray) -> None:
    millimetres = np.rint(metres * 1000).astype(np.uint16)
    Image.fromarray(millimetres).save(folder / "depth" / "0.png")


def test_registered_depth_of_equal_size_is_unchanged(make_capture: MakeCapture) -> None:
    folder = make_capture()
    metres = np.random.default_rng(0).uniform(0.5, 5, (48, 64))
    write_depth(folder, metres)
    assert np.allclose(depth_at_image(open_capture(folder).frame(0)), metres, atol=6e-4)


@pytest.mark.parametrize("with_intrinsics", [True, False])
@pytest.mark.parametrize("depth_size", [(24, 32), (96, 128), (16, 64), (30, 50)])
def test_depth_of_another_size_is_read_at_the_same_ray(
    make_capture: MakeCapture, depth_size: tuple[int, int], with_intrinsics: bool
) -> None:
    folder = make_capture(depth_size=depth_size)
    height, width = depth_size
    across = np.broadcast_to(1 + (np.arange(width) + 0.5) / width, depth_size)
    write_depth(folder, across)
    if not with_intrinsics:
        (folder / "intrinsic" / "intrinsic_depth.txt").unlink()
    expected = 1 + (np.arange(64) + 0.5) / 64
    depth = depth_at_image(open_capture(folder).frame(0))
    assert depth.shape == (48, 64)
    # Half a depth pixel, and half a millimetre of rounding.
    assert np.abs(depth - expected).max() <= 0.5 / width + 6e-4
    assert height * np.ptp(depth, axis=0).max() == 0


def test_intrinsics_of_the_depth_camera_are_followed(make_capture: MakeCapture) -> None:
    folder = make_capture()
    # Twice the focal length: the depth camera sees the middle half of the colour image.
    (folder / "intrinsic" / "intrinsic_depth.txt").write_text("128 0 31.5 0 128 23.5 0 0 1")
    depth = depth_at_image(open_capture(folder).frame(0))
    assert (depth[12:36, 16:48] == 2.5).all()
    assert (depth[:11] == 0).all() and (depth[:, :15] == 0).all() and (depth[:, 49:] == 0).all()


@pytest.mark.shared
def test_real_views_agree_with_their_depth(shared_data: Path) -> None:
    """Points of the anchor's depth land on the sources' depth: poses, K and depth fit."""
    capture = open_capture(shared_data / "hololens")
    view_set = read_view_sets(shared_data / "hololens" / "view_sets.json", capture)[3]
    frames = [capture.frame(id) for id in (view_set.anchor, *view_set.sources[:2])]
    size = frames[0].image_size
    images, views = load_views(frames, work_size=size)
    assert images.shape == (3, 3, *size)
    depths = [depth_at_image(frame) for frame in frames]
    rows, columns = np.nonzero(depths[0])
    pixels = np.stack([columns, rows, np.ones_like(rows)]).astype(np.float64)
    points = np.linalg.inv(frames[0].K) @ pixels * depths[0][rows, columns]
    for view in (1, 2):
        pose = views.cam_from_world[view].double().numpy()
        seen = pose[:3, :3] @ points + pose[:3, 3:]
        x, y = np.rint((views.K[view].double().numpy() @ seen)[:2] / seen[2]).astype(int)
        inside = (seen[2] > 0.1) & (x >= 0) & (x < size[1]) & (y >= 0) & (y < size[0])
        there = depths[view][y[inside], x[inside]]
        error = np.abs(there - seen[2, inside])[there > 0] / there[there > 0]
        assert np.median(error) < 0.02
