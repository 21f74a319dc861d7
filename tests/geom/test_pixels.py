"""The pixel convention: grids, borders, intrinsics of resized and cropped images."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from deltas_geom import (
    ShapeError,
    crop_intrinsics,
    in_image,
    normalize_pixels,
    pixel_grid,
    project,
    resize_intrinsics,
    resize_pixels,
)
from deltas_geom.testing import PosedScene
from deltas_geom.testing.scenes import IMAGE_SIZE
from deltas_geom.testing.strategies import image_pixels, posed_scenes

sizes = st.tuples(st.integers(1, 999), st.integers(1, 999))


def test_intrinsics_must_be_3x3() -> None:
    with pytest.raises(ShapeError, match="K must have shape"):
        resize_intrinsics(torch.eye(4), old_size=(2, 2), new_size=(1, 1))
    with pytest.raises(ShapeError, match="K must have shape"):
        crop_intrinsics(torch.eye(4), left=1, top=1)


def test_a_grid_is_in_raster_order(dtype: torch.dtype) -> None:
    grid = pixel_grid((3, 4), dtype=dtype)
    assert grid.shape == (12, 2) and grid.dtype == dtype
    assert grid[5].tolist() == [1, 1]


@given(scene=posed_scenes(), new_size=sizes)
def test_projection_is_equivariant_to_resizing(
    scene: PosedScene, new_size: tuple[int, int]
) -> None:
    resized = scene.views.resize(old_size=IMAGE_SIZE, new_size=new_size)
    wanted = resize_pixels(scene.pixels, old_size=IMAGE_SIZE, new_size=new_size)
    assert_close(project(resized, scene.points).pixels, wanted, rtol=0, atol=1e-9)  # px


@given(scene=posed_scenes(), left=st.integers(-99, 99), top=st.integers(-99, 99))
def test_projection_is_equivariant_to_cropping(scene: PosedScene, left: int, top: int) -> None:
    cropped = project(scene.views.crop(left=left, top=top), scene.points).pixels
    wanted = scene.pixels - torch.tensor([left, top])
    assert_close(cropped, wanted, rtol=0, atol=1e-9)  # px


@given(pixels=image_pixels(4), new_size=sizes)
def test_resizing_there_and_back_is_nothing(
    pixels: torch.Tensor, new_size: tuple[int, int]
) -> None:
    there = resize_pixels(pixels, old_size=IMAGE_SIZE, new_size=new_size)
    back = resize_pixels(there, old_size=new_size, new_size=IMAGE_SIZE)
    assert_close(back, pixels, rtol=0, atol=1e-9)  # px


@given(pixels=image_pixels(4), new_size=sizes)
def test_normalized_pixels_do_not_depend_on_the_resolution(
    pixels: torch.Tensor, new_size: tuple[int, int]
) -> None:
    resized = resize_pixels(pixels, old_size=IMAGE_SIZE, new_size=new_size)
    assert_close(
        normalize_pixels(resized, image_size=new_size),
        normalize_pixels(pixels, image_size=IMAGE_SIZE),
        rtol=0,
        atol=1e-12,  # image halves
    )


@given(pixels=image_pixels(8))
def test_a_pixel_is_in_the_image_iff_its_coordinates_are_within_one(pixels: torch.Tensor) -> None:
    beyond = 2 * pixels  # some in, some out
    normalized = normalize_pixels(beyond, image_size=IMAGE_SIZE)
    inside = (normalized.abs() <= 1).all(dim=-1)
    assert (in_image(beyond, image_size=IMAGE_SIZE) == inside).all()


def test_the_border_keeps_a_distance() -> None:
    pixels = torch.tensor([[0.5, 2.0], [0.4, 2.0], [7.5, 2.0], [8.6, 2.0]])
    inside = in_image(pixels, image_size=(6, 9), border=1.0)
    assert inside.tolist() == [True, False, True, False]
