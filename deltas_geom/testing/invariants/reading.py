"""Invariants of reading a feature map at pixels of the image."""

import torch
from torch import Tensor

from deltas_geom.cameras.pixels import pixel_grid, read_map
from deltas_geom.testing.agreement import (
    EXTREMES,
    VALUE_TOLERANCE,
    assert_finite,
    assert_gradients,
    assert_near,
)
from deltas_geom.testing.planar import MapScene
from deltas_geom.testing.registry import invariant
from deltas_geom.testing.target import Target


@invariant("sample_map", scenes="maps")
def a_map_is_read_exactly_at_the_centres_of_its_cells(target: Target, scene: MapScene) -> None:
    """At the centre of a cell the map's own value is read."""
    centers = _centers(scene)
    wanted = scene.feature_map.flatten(1).mT
    assert_near(_read(target, scene, centers), wanted, VALUE_TOLERANCE, "(value)")


@invariant("sample_map", scenes="maps")
def a_linear_field_is_read_exactly(
    target: Target, scene: MapScene, *, slope: tuple[float, float] = (1.0, -0.5)
) -> None:
    """Between the centres of the outer cells, a map linear in (x, y) is read without error."""
    factor = scene.pixels.new_tensor(slope)
    field = (_centers(scene) @ factor).reshape(1, *scene.feature_map.shape[1:])
    pixels = _inner(scene)
    found = _read(target, scene._replace(feature_map=field), pixels)[:, 0]
    # Slopes are of the order of 1 per px, so that an error is one of place.
    assert_near(found, pixels @ factor, 1e-8, "px (along the slope)")


@invariant("sample_map", scenes="maps")
def reading_follows_a_shift_of_the_map(target: Target, scene: MapScene) -> None:
    """A map cropped by whole cells is read at pixels shifted with it."""
    stride_y, stride_x = _stride(scene)
    cropped = scene._replace(
        feature_map=scene.feature_map[:, 1:, 1:],
        image_size=(scene.image_size[0] - stride_y, scene.image_size[1] - stride_x),
    )
    shift = scene.pixels.new_tensor([stride_x, stride_y])
    pixels = _inner(cropped)
    found = _read(target, cropped, pixels)
    assert_near(found, _read(target, scene, pixels + shift), VALUE_TOLERANCE, "(value)")


@invariant("sample_map", scenes="maps")
def reading_is_linear_in_the_map(target: Target, scene: MapScene) -> None:
    """What is read of a weighted sum of maps is the weighted sum of what is read of each."""
    other = scene.feature_map.flip(-1).square()
    both = scene._replace(feature_map=2 * scene.feature_map - 3 * other)
    found = _read(target, both, scene.pixels)
    alone = [
        _read(target, scene._replace(feature_map=one), scene.pixels)
        for one in (scene.feature_map, other)
    ]
    assert_near(found, 2 * alone[0] - 3 * alone[1], VALUE_TOLERANCE, "(value)")


@invariant("sample_map", "autograd", scenes="maps")
def gradients_of_what_is_read_are_finite_differences(target: Target, scene: MapScene) -> None:
    """Between centres of cells the gradient by map and pixels is that of finite differences."""
    # At a centre what is read has a kink.
    height, width = scene.feature_map.shape[1:]
    inner = _centers(scene).reshape(height, width, 2)[:-1, :-1].flatten(0, 1)
    stride_y, stride_x = _stride(scene)
    pixels = inner + 0.3 * inner.new_tensor([stride_x, stride_y])

    def read(feature_map: Tensor, pixels: Tensor) -> Tensor:
        return _read(target, scene._replace(feature_map=feature_map), pixels)

    assert_gradients(read, [scene.feature_map, pixels], ("feature_map", "pixels"), "(value)")


@invariant("sample_map", scenes="maps")
def what_is_read_is_finite(
    target: Target, scene: MapScene, *, pixels: Tensor | None = None
) -> None:
    """A finite map is read as finite at any finite pixel."""
    if pixels is None:
        pixels = EXTREMES[:, :2].to(scene.pixels)
    assert_finite(_read(target, scene, pixels), "value")


@invariant("correlate", scenes="maps")
def correlating_is_reading_and_multiplying(target: Target, scene: MapScene) -> None:
    """Scores are the dot products of descriptors with the features read at each place."""
    assert target.correlate is not None
    pixels = _inner(scene)
    places = torch.stack([pixels, pixels.flip(0)], dim=1)
    found = target.correlate(scene.descriptors, scene.feature_map, places, scene.image_size)
    read = read_map(scene.feature_map, places.flatten(0, 1), image_size=scene.image_size)
    read = read.mT.reshape(*places.shape[:2], -1)
    wanted = (scene.descriptors[:, None] * read).sum(dim=-1)
    assert_near(found, wanted, VALUE_TOLERANCE, "(score)")


def _read(target: Target, scene: MapScene, pixels: Tensor) -> Tensor:
    assert target.sample_map is not None
    return target.sample_map(scene.feature_map, pixels, scene.image_size)


def _stride(scene: MapScene) -> tuple[int, int]:
    """Pixels of a cell, down and across."""
    height, width = scene.image_size
    return height // scene.feature_map.shape[1], width // scene.feature_map.shape[2]


def _centers(scene: MapScene) -> Tensor:
    """Pixels ``(h w, 2)`` of the centres of cells, in raster order."""
    stride_y, stride_x = _stride(scene)
    height, width = scene.feature_map.shape[1:]
    cells = pixel_grid((height, width), dtype=scene.pixels.dtype)
    return (cells + 0.5) * scene.pixels.new_tensor([stride_x, stride_y]) - 0.5


def _inner(scene: MapScene) -> Tensor:
    """The scene's pixels, moved between the centres of the outer cells: no border is read."""
    centers = _centers(scene)
    return scene.pixels.maximum(centers[0]).minimum(centers[-1])
