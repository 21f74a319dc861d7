"""Invariants of samples along epipolar segments, and of inverse depths common to all."""

from collections.abc import Iterator

import torch
from torch import Tensor

from deltas_geom.cameras.pixels import in_image
from deltas_geom.testing.agreement import (
    PIXEL_TOLERANCE,
    assert_finite,
    assert_near,
    is_good,
    slack,
)
from deltas_geom.testing.registry import first_views, invariant
from deltas_geom.testing.scenes import IMAGE_SIZE, PosedScene
from deltas_geom.testing.sights import VISIBLE, assert_covers, on_edge, sights
from deltas_geom.testing.target import DepthRange, Target

RANGE: DepthRange = (0.7, 20.0)
"""Not as near as for segments: at the source's plane, rounding of a depth is more than px."""


@invariant("samples", scenes="segments")
def samples_are_seen_at_their_inverse_depths(
    target: Target, scene: PosedScene, *, depth_range: DepthRange = RANGE, count: int = 7
) -> None:
    """The pixel of a sample is the projection of the anchor's pixel at its inverse depth."""
    for pixels, inv_depth, visible in _spaced(target, scene, depth_range, count):
        homogeneous = sights(scene.views, scene.pixels[0]).at(inv_depth)
        offset = torch.where(
            visible[:, None, None], pixels - homogeneous[..., :2] / homogeneous[..., 2:], 0.0
        )
        assert_near(offset, torch.zeros_like(offset), PIXEL_TOLERANCE, "px")


@invariant("samples", scenes="segments")
def samples_run_from_the_far_to_the_near_end(
    target: Target, scene: PosedScene, *, depth_range: DepthRange = RANGE, count: int = 7
) -> None:
    """Inverse depth grows from sample to sample, and all visible depths lie between the outer two.

    All samples are in the image, and the outer ones within the depth range.
    """
    near, far = depth_range
    border = -slack() * PIXEL_TOLERANCE
    for pixels, inv_depth, visible in _spaced(target, scene, depth_range, count):
        rounding = 1e-10 * slack()
        shrinks = (inv_depth.diff(dim=-1) <= 0).any(dim=-1) & visible
        if bool(shrinks.any()):
            item = int(shrinks.nonzero()[0])
            raise AssertionError(f"inverse depths of item {item}: {inv_depth[item].tolist()} 1/m")
        beyond = (inv_depth[:, 0] < 1 / far - rounding) | (inv_depth[:, -1] > 1 / near + rounding)
        if bool((beyond & visible).any()):
            item = int((beyond & visible).nonzero()[0])
            first, last = inv_depth[item, [0, -1]].tolist()
            raise AssertionError(f"item {item} is sampled from {first} to {last} 1/m")
        outside = visible[:, None] & ~in_image(pixels, image_size=IMAGE_SIZE, border=border)
        if bool(outside.any()):
            item, sample = outside.nonzero()[0].tolist()
            raise AssertionError(f"item {item} is sampled at {pixels[item, sample].tolist()} px")
        ends = (pixels[:, 0], pixels[:, -1], visible)
        assert_covers(scene.views, scene.pixels[0], ends, depth_range, IMAGE_SIZE)


@invariant("depth_samples", scenes="segments")
def samples_are_even_in_inverse_depth(
    target: Target, scene: PosedScene, *, depth_range: DepthRange = RANGE, count: int = 7
) -> None:
    """Steps of inverse depth along a segment are equal."""
    _, inv_depth, status = _sampled(target.depth_samples, scene, depth_range, count)
    _assert_even(inv_depth.diff(dim=-1), is_good(status, VISIBLE), "1/m")


@invariant("pixel_samples", scenes="segments")
def samples_are_even_in_pixels(
    target: Target, scene: PosedScene, *, depth_range: DepthRange = RANGE, count: int = 7
) -> None:
    """Steps between the pixels of a segment's samples are equal."""
    pixels, _, status = _sampled(target.pixel_samples, scene, depth_range, count)
    _assert_even(pixels.diff(dim=-2).norm(dim=-1), is_good(status, VISIBLE), "px")


@invariant("samples", scenes="segments")
def samples_are_finite(target: Target, scene: PosedScene, *, pixels: Tensor | None = None) -> None:
    """Samples are finite, even those of a segment that is empty or a point."""
    if pixels is not None:
        scene = scene._replace(pixels=pixels.expand(2, *pixels.shape))
    for found, inv_depth, _ in _spaced(target, scene, (0.1, 0.4), 5):
        assert_finite(found, "pixels")
        assert_finite(inv_depth, "inverse depths")


@invariant("sweep", scenes="segments")
def a_sweep_sees_each_inverse_depth_where_it_is(
    target: Target, scene: PosedScene, *, inv_depth: Tensor | None = None
) -> None:
    """An inverse depth, 0 included, is visible if in front and in the image, and at its pixel."""
    assert target.sweep is not None
    if inv_depth is None:
        inv_depth = torch.tensor([0.0, 0.05, 0.3, 1.0, 2.5], dtype=scene.views.K.dtype)
    pair = first_views(scene, 2)
    found, visible = target.sweep(
        pair.views.K, pair.views.cam_from_world, pair.pixels[0], inv_depth, IMAGE_SIZE
    )
    rays = sights(pair.views, pair.pixels[0])
    wanted, truly = rays.seen(inv_depth.expand(found.shape[:-1]), IMAGE_SIZE)
    wrong = (visible != truly) & ~on_edge(wanted, IMAGE_SIZE)
    if bool(wrong.any()):
        item, sample = wrong.nonzero()[0].tolist()
        says, w = bool(visible[item, sample]), float(inv_depth[sample])
        raise AssertionError(f"item {item} at {w} 1/m: visible is {says}, in truth {not says}")
    offset = torch.where((truly & visible)[..., None], found - wanted, 0.0)
    assert_near(offset, torch.zeros_like(offset), PIXEL_TOLERANCE, "px")
    assert_finite(found, "pixels")


def _sampled(
    sample: object, scene: PosedScene, depth_range: DepthRange, count: int
) -> tuple[Tensor, Tensor, Tensor]:
    assert callable(sample)
    pair = first_views(scene, 2)
    pixels, inv_depth, status = sample(
        pair.views.K, pair.views.cam_from_world, pair.pixels[0], depth_range, IMAGE_SIZE, count
    )
    return pixels, inv_depth, status


def _spaced(
    target: Target, scene: PosedScene, depth_range: DepthRange, count: int
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Pixels, inverse depths and visibility, of each spacing that the target offers."""
    for sample in (target.depth_samples, target.pixel_samples):
        if sample is not None:
            pixels, inv_depth, status = _sampled(sample, scene, depth_range, count)
            yield pixels, inv_depth, is_good(status, VISIBLE)


def _assert_even(steps: Tensor, visible: Tensor, unit: str) -> None:
    off = torch.where(visible[:, None], steps - steps.mean(dim=-1, keepdim=True), 0.0)
    assert_near(off, torch.zeros_like(off), 1e-7, f"{unit} (step from the mean step)")
