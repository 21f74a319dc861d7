"""Places along segments, and feature maps read at pixels."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import (
    Segments,
    ShapeError,
    epipolar_segments,
    in_image,
    sample_inv_depths,
    sample_map,
    sample_segments,
)
from deltas_geom.testing import PosedScene, forward_motion, on_baseline
from deltas_geom.testing.changes import ELSEWHERE
from deltas_geom.testing.invariants import INVARIANTS
from deltas_geom.testing.planar import MapScene
from deltas_geom.testing.scenes import IMAGE_SIZE
from deltas_geom.testing.strategies import extreme, map_scenes, posed_scenes, rigs, vectors
from deltas_geom.testing.targets import deltas

SPACINGS = ["inv_depth", "pixels"]
OURS = deltas()
ALONG = [
    "samples_are_seen_at_their_inverse_depths",
    "samples_run_from_the_far_to_the_near_end",
    "samples_are_even_in_inverse_depth",
    "samples_are_even_in_pixels",
]
READ = [name for name, invariant in INVARIANTS.items() if "sample_map" in invariant.needs]


def segments_of(scene: PosedScene, near: float = 0.7, far: float = 20.0) -> Segments:
    return epipolar_segments(
        scene.views, scene.pixels[0], depth_range=(near, far), image_size=IMAGE_SIZE
    )


def test_wrong_arguments_are_named() -> None:
    scene = forward_motion()
    segments = segments_of(scene)
    with pytest.raises(ValueError, match="num_samples must be 2 or more, got 1"):
        sample_segments(segments, 1)
    with pytest.raises(ValueError, match="spacing must be 'inv_depth' or 'pixels', got 'depth'"):
        sample_segments(segments, 4, spacing="depth")
    with pytest.raises(ShapeError, match="feature_map must have shape"):
        sample_map(torch.zeros(4, 4), torch.zeros(1, 2), image_size=(4, 4))
    with pytest.raises(ShapeError, match="inv_depths must have shape"):
        sample_inv_depths(scene.views, scene.pixels[0], torch.tensor(1.0), image_size=(4, 4))


@pytest.mark.parametrize("kind", [list, torch.tensor, np.array])
def test_offsets_are_any_row_of_numbers(kind: Callable[[list[float]], Any]) -> None:
    segments = segments_of(forward_motion())
    for offsets in ([], [-1.0, 0.5]):
        found = sample_segments(segments, 3, offsets=kind(offsets)).pixels
        assert torch.equal(found, sample_segments(segments, 3, offsets=tuple(offsets)).pixels)


@given(scene=posed_scenes(), count=st.integers(2, 9))
@pytest.mark.parametrize("name", ALONG)
def test_samples_run_evenly_over_what_is_visible(name: str, scene: PosedScene, count: int) -> None:
    INVARIANTS[name](OURS, scene, count=count)


@given(scene=rigs(), pixels=extreme(3, 2))
def test_samples_are_finite(scene: PosedScene, pixels: Tensor) -> None:
    INVARIANTS["samples_are_finite"](OURS, scene, pixels=pixels)


@given(scene=posed_scenes(num_views=3))
@pytest.mark.parametrize("spacing", SPACINGS)
def test_the_outer_samples_are_the_ends(spacing: str, scene: PosedScene) -> None:
    segments = segments_of(scene)
    samples = sample_segments(segments, 6, spacing=spacing)
    assert_close(samples.pixels[..., 0, 0, :], segments.start, rtol=0, atol=0)
    assert_close(samples.pixels[..., 0, -1, :], segments.end, rtol=0, atol=1e-9)  # px
    assert_close(samples.inv_depth[..., -1], segments.inv_depth_end, rtol=1e-12, atol=0)


@given(scene=st.one_of(posed_scenes(), rigs()), inverse=vectors(1, within=0.6, size=4))
def test_common_inverse_depths_are_seen_where_they_are(scene: PosedScene, inverse: Tensor) -> None:
    inv_depth = 0.6 + inverse[0]  # 1/m, from infinity to 0.8 m
    INVARIANTS["a_sweep_sees_each_inverse_depth_where_it_is"](OURS, scene, inv_depth=inv_depth)


@given(scene=posed_scenes())
def test_infinity_is_a_sample_like_others(scene: PosedScene) -> None:
    inv_depths = torch.tensor([0.0, 1e-9]).double()
    samples = sample_inv_depths(scene.views, scene.pixels[0], inv_depths, image_size=IMAGE_SIZE)
    infinity, far = samples.pixels.squeeze(-3).unbind(dim=-2)
    assert_close(infinity, far, rtol=0, atol=1e-5)  # px


@given(scene=posed_scenes(), offset=st.floats(-3, 3))
def test_offset_lines_are_parallel_at_their_distance(scene: PosedScene, offset: float) -> None:
    samples = sample_segments(segments_of(scene), 4, offsets=(0, offset))
    beside = samples.pixels[..., 1, :, :] - samples.pixels[..., 0, :, :]
    distance = torch.where(samples.mask[..., 0, :], beside.norm(dim=-1), abs(offset))
    assert_close(distance, torch.full_like(distance, abs(offset)), rtol=0, atol=1e-9)  # px


def test_offset_samples_beyond_the_image_are_masked() -> None:
    segments = segments_of(forward_motion())
    samples = sample_segments(segments, 9, offsets=(-600, 0), image_size=IMAGE_SIZE)
    assert (samples.mask == in_image(samples.pixels, image_size=IMAGE_SIZE)).all()
    assert not samples.mask[..., 0, :].any() and samples.mask[..., 1, 1:-1].all()


@given(scene=map_scenes(), slope=vectors(1, within=1.0, size=2))
def test_a_linear_field_is_sampled_exactly(scene: MapScene, slope: Tensor) -> None:
    INVARIANTS["a_linear_field_is_read_exactly"](OURS, scene, slope=tuple(slope[0].tolist()))


@given(scene=map_scenes())
@pytest.mark.parametrize("name", READ)
def test_maps_are_read_bilinearly(name: str, scene: MapScene) -> None:
    INVARIANTS[name](OURS, scene)


@given(pixels=extreme(4, 2))
def test_no_finite_pixel_reads_nan_or_inf(pixels: Tensor) -> None:
    for dtype in (torch.float32, torch.float64):
        features = torch.rand(3, 4, 4, dtype=dtype, requires_grad=True)
        keypoints = pixels.to(dtype).requires_grad_()
        read = sample_map(features, keypoints, image_size=(16, 16))
        assert read.isfinite().all()
        for gradient in torch.autograd.grad(read.sum(), (features, keypoints)):
            assert gradient.isfinite().all()


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf])
def test_a_pixel_that_is_not_finite_reads_the_border_without_gradient(
    bad: float, dtype: torch.dtype
) -> None:
    # Of 3000 pixels, as the backward pass of grid_sample itself writes out of bounds at NaN.
    ramp = torch.arange(4.0, dtype=dtype).expand(2, 4, 4).clone().requires_grad_()
    pixels = torch.full((3000, 2), 1.5, dtype=dtype)
    pixels[::3, 0], pixels[1::3, 1] = bad, bad
    pixels.requires_grad_()
    read = sample_map(ramp, pixels, image_size=(4, 4))
    column = torch.full((3000, 2), 1.5, dtype=dtype)
    column[::3] = 3.0 if bad == torch.inf else 0.0
    assert_close(read, column, rtol=1e-6, atol=0)
    of_map, of_pixels = torch.autograd.grad(read.sum(), (ramp, pixels))
    assert_close(of_map.sum(), torch.tensor(6000.0, dtype=dtype), rtol=1e-5, atol=0)
    assert (of_pixels[::3] == 0).all() and (of_pixels[1::3, 1] == 0).all()
    assert_close(of_pixels[1::3, 0], torch.full((1000,), 2.0, dtype=dtype), rtol=1e-5, atol=0)


@pytest.mark.parametrize("half", [torch.float16, torch.bfloat16])
def test_a_map_of_half_precision_is_read_at_exact_places(half: torch.dtype) -> None:
    places = torch.tensor([[[13.25, 10.0], [301.5, 10.0], [633.25, 10.0]]])
    cells = torch.arange(0.0, 80).to(half).expand(1, 4, 80).clone().requires_grad_()
    pixels = places.clone().requires_grad_()
    read = sample_map(cells, pixels, image_size=(32, 640))
    assert read.dtype == torch.float32
    wanted = (places[..., :1] + 0.5) / 8 - 0.5
    assert_close(read, wanted, rtol=0, atol=1e-4)  # cells
    of_map, of_pixels = torch.autograd.grad(read.sum(), (cells, pixels))
    assert of_map.dtype == half
    assert_close(of_pixels[..., 0], torch.full((1, 3), 1 / 8), rtol=1e-4, atol=0)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert_close(sample_map(cells, places, image_size=(32, 640)), read, rtol=0, atol=0)
    assert sample_map(cells.double(), places, image_size=(32, 640)).dtype == torch.float64


def test_samples_at_the_sources_plane_are_masked(dtype: torch.dtype) -> None:
    scene = on_baseline(dtype=dtype)  # the source stands 0.5 m ahead
    inv_depths = torch.tensor([0.0, 1.0, 1.98, 2 - 18e-6, 2.0, 2 + 4e-7], dtype=dtype)
    for views, unit in ((scene.views, 1.0), (ELSEWHERE.views(on_baseline().views), 3.0)):
        samples = sample_inv_depths(
            views.to(dtype), scene.pixels[0], inv_depths / unit, image_size=IMAGE_SIZE
        )
        assert samples.mask[0, 0, 0].tolist() == [True, True, True, False, False, False]
        place = samples.pixels[0, 0, 0, :3]
        assert_close(place, scene.pixels[1].expand(3, 2), rtol=1e5 * torch.finfo(dtype).eps, atol=0)


@given(pixels=extreme(3, 2), inv_depths=extreme(4))
def test_no_finite_inverse_depth_gives_nan_or_inf(pixels: Tensor, inv_depths: Tensor) -> None:
    for dtype in (torch.float32, torch.float64):
        views = forward_motion(dtype=dtype).views
        keypoints = pixels.to(dtype).requires_grad_()
        inverse = inv_depths.abs().to(dtype).requires_grad_()
        samples = sample_inv_depths(views, keypoints, inverse, image_size=IMAGE_SIZE)
        assert samples.pixels.isfinite().all()
        for gradient in torch.autograd.grad(samples.pixels.sum(), (keypoints, inverse)):
            assert gradient.isfinite().all()


@given(scene=posed_scenes())
def test_float32_is_within_its_bound_of_float64(scene: PosedScene) -> None:
    single = scene._replace(views=scene.views.to(torch.float32), pixels=scene.pixels.float())
    inv_depths = torch.tensor([0.0, 0.2, 0.5])
    found = sample_inv_depths(single.views, single.pixels[0], inv_depths, image_size=IMAGE_SIZE)
    exact = sample_inv_depths(
        scene.views, scene.pixels[0], inv_depths.double(), image_size=IMAGE_SIZE
    )
    # 32 roundings of terms up to 1000 px.
    assert_close(found.pixels.double(), exact.pixels, rtol=0, atol=32 * 6e-8 * 1000)  # px


def test_gradients_are_right() -> None:
    scene = forward_motion()
    keypoints = scene.pixels[0].clone().requires_grad_()

    def along(keypoints: Tensor) -> Tensor:
        found = epipolar_segments(
            scene.views, keypoints, depth_range=(0.7, 10), image_size=IMAGE_SIZE
        )
        by_depth = sample_segments(found, 3, offsets=(0, 1)).pixels
        return by_depth + sample_segments(found, 3, spacing="pixels", offsets=(0, 1)).pixels

    def common(keypoints: Tensor, inv_depths: Tensor) -> Tensor:
        return sample_inv_depths(scene.views, keypoints, inv_depths, image_size=IMAGE_SIZE).pixels

    inv_depths = torch.tensor([0.0, 0.3, 0.8]).double().requires_grad_()
    features = torch.rand(2, 4, 5, dtype=torch.float64, requires_grad=True)
    places = torch.tensor([[2.2, 3.1], [5.7, 4.4]]).double().requires_grad_()

    def read(features: Tensor, places: Tensor) -> Tensor:
        return sample_map(features, places, image_size=(8, 10))

    assert torch.autograd.gradcheck(along, (keypoints,))
    assert torch.autograd.gradcheck(common, (keypoints, inv_depths))
    assert torch.autograd.gradcheck(read, (features, places))


def test_samples_behind_the_source_or_of_a_nan_keypoint_are_masked_without_gradient() -> None:
    views = forward_motion().views  # the source stands 0.5 m ahead
    keypoints = torch.tensor([[300.0, 200.0], [torch.nan, 200.0]]).double().requires_grad_()
    inv_depths = torch.tensor([0.1, 2.0, 4.0]).double().requires_grad_()
    samples = sample_inv_depths(views, keypoints, inv_depths, image_size=IMAGE_SIZE)
    assert samples.mask[0, :, 0].tolist() == [[True, False, False], [False] * 3]
    assert (samples.pixels[0, 1] == 0).all()
    gradient, of_keypoints = torch.autograd.grad(samples.pixels.sum(), (inv_depths, keypoints))
    assert gradient[0] != 0 and (gradient[1:] == 0).all() and of_keypoints.isfinite().all()


def test_an_end_near_the_cameras_plane_does_not_overshoot() -> None:
    one = torch.ones(1, 1, dtype=torch.float64)
    end = torch.tensor([[[100.0, 0.0]]]).double()
    status = torch.zeros(1, 1, dtype=torch.int8)
    for foreshortening in (1e-17, 1e17):
        segments = Segments(0 * end, end, 0.1 * one, one, status, foreshortening * one)
        for spacing in SPACINGS:
            samples = sample_segments(segments, 5, spacing=spacing)
            assert samples.inv_depth.max() <= 1 and samples.inv_depth.min() >= 0.1
            assert samples.inv_depth[0, 0, -1] == 1 and samples.pixels[0, 0, 0, -1, 0] == 100
