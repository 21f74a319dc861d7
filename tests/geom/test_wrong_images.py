"""Wrong readings, soft-argmaxes and depth images, each with exactly what it fails."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from deltas_geom import normalize_pixels
from deltas_geom.testing.conformance import conformance
from deltas_geom.testing.invariants import INVARIANTS
from deltas_geom.testing.target import ImageSize, Target
from deltas_geom.testing.targets import deltas

OURS = deltas()
Size = ImageSize


def ours(feature: str) -> Callable[..., Any]:
    function: Callable[..., Any] = getattr(OURS, feature)
    return function


def aligned(m: Tensor, x: Tensor, size: Size) -> Tensor:
    grid = 2 * x / (x.new_tensor(size[::-1]) - 1) - 1
    return F.grid_sample(m[None], grid[None, None], padding_mode="border", align_corners=True)[
        0, :, 0
    ].mT


def nearest_cell(m: Tensor, x: Tensor, size: Size) -> Tensor:
    grid = normalize_pixels(x, image_size=size)[None, None]
    return F.grid_sample(m[None], grid, "nearest", "border", align_corners=False)[0, :, 0].mT


def unguarded_argmax(x: Tensor, p: Tensor, mask: Tensor) -> Tensor:
    share = x.exp() * mask
    return torch.where(mask[:, None], share[:, None] * p, 0.0).sum(dim=0) / share[mask].sum()


def uncentred(x: Tensor, p: Tensor, mask: Tensor) -> Tensor:
    share = x.masked_fill(~mask, -torch.inf).softmax(dim=-1)
    return (share[:, None] * p).mT @ p


def heatmap(change: Callable[[Tensor, Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    return lambda x: change(ours("heatmap_argmax")(x), x)


def in_order(p: Tensor, z: Tensor, size: Size) -> Tensor:
    """The last point wins, as a plain assignment does."""
    image = torch.zeros(size, dtype=z.dtype)
    for (x, y), depth in zip((p + 0.5).floor().clamp(-1e6, 1e6).long().tolist(), z, strict=True):
        if 0 <= x < size[1] and 0 <= y < size[0] and depth > 0 and depth.isfinite():
            image[y, x] = depth
    return image


def onto_the_edge(p: Tensor, z: Tensor, size: Size) -> Tensor:
    inside = p.clamp(min=0).minimum(p.new_tensor(size[::-1]) - 1)
    return ours("rasterize")(inside, z, size)


def into_the_next_row(p: Tensor, z: Tensor, size: Size) -> Tensor:
    """The index y W + x alone is checked."""
    x, y = p.round().unbind(dim=-1)
    index = y * size[1] + x
    row = (index / size[1]).floor()
    return ours("rasterize")(torch.stack([index - row * size[1], row], dim=-1), z, size)


Images = tuple[Tensor, Tensor]


def unguarded_mean(p: Tensor, z: Tensor, w: Tensor, size: Size) -> Images:
    x, y = (p + 0.5).floor().clamp(-1e6, 1e6).long().unbind(dim=-1)
    inside = (x >= 0) & (x < size[1]) & (y >= 0) & (y < size[0])
    index = (y * size[1] + x)[inside]
    empty = z.new_zeros(size[0] * size[1])
    total = empty.index_add(0, index, w[inside])
    moment = empty.index_add(0, index, (w * z)[inside])
    return torch.where(total > 0, moment / total, 0.0).reshape(size), total.reshape(size)


def nan_where_empty(p: Tensor, z: Tensor, w: Tensor, size: Size) -> Images:
    depth, weight = ours("mean_depth")(p, z, w, size)
    return depth / (weight > 0), weight


def lost_weight(p: Tensor, z: Tensor, w: Tensor, size: Size) -> Images:
    depth, weight = ours("splat")(p, z, w, size)
    return depth, weight * (weight > 0.2)


BROKEN: list[tuple[Target, set[str]]] = [
    (
        Target("aligned corners", sample_map=aligned),
        {
            "a_map_is_read_exactly_at_the_centres_of_its_cells",
            "a_linear_field_is_read_exactly",
            "reading_follows_a_shift_of_the_map",
        },
    ),
    (
        Target(
            "map half a pixel off",
            sample_map=lambda m, x, size: ours("sample_map")(m, x + 0.5, size),
        ),
        {
            "a_map_is_read_exactly_at_the_centres_of_its_cells",
            "a_linear_field_is_read_exactly",
        },
    ),
    (
        Target("map y, x", sample_map=lambda m, x, size: ours("sample_map")(m, x.flip(-1), size)),
        {
            "a_map_is_read_exactly_at_the_centres_of_its_cells",
            "a_linear_field_is_read_exactly",
            "reading_follows_a_shift_of_the_map",
        },
    ),
    (
        Target("nearest cell", sample_map=nearest_cell),
        {
            "a_linear_field_is_read_exactly",
        },
    ),
    (
        Target("clamped", sample_map=lambda m, x, size: ours("sample_map")(m, x, size).relu()),
        {
            "a_map_is_read_exactly_at_the_centres_of_its_cells",
            "a_linear_field_is_read_exactly",
            "reading_is_linear_in_the_map",
        },
    ),
    (
        Target(
            "brighter to the right",
            sample_map=lambda m, x, size: ours("sample_map")(m, x, size) + 1e-3 * x[:, :1],
        ),
        {
            "a_map_is_read_exactly_at_the_centres_of_its_cells",
            "a_linear_field_is_read_exactly",
            "reading_follows_a_shift_of_the_map",
            "reading_is_linear_in_the_map",
        },
    ),
    (
        Target(
            "unbounded",
            sample_map=lambda m, x, size: (
                ours("sample_map")(m, x, size) / (x.abs() < 1e9).all(-1)[:, None]
            ),
        ),
        {
            "what_is_read_is_finite",
        },
    ),
    (
        Target(
            "cosine",
            sample_map=OURS.sample_map,
            correlate=lambda d, m, x, size: ours("correlate")(F.normalize(d, dim=-1), m, x, size),
        ),
        {
            "correlating_is_reading_and_multiplying",
        },
    ),
    (
        Target("half as warm", soft_argmax=lambda x, p, m: ours("soft_argmax")(2 * x, p, m)),
        {
            "the_soft_argmax_is_the_mean_under_the_softmax",
        },
    ),
    (
        Target("argmax + 1e-3", soft_argmax=lambda x, p, m: 1.001 * ours("soft_argmax")(x, p, m)),
        {
            "the_soft_argmax_is_the_mean_under_the_softmax",
            "the_soft_argmax_of_a_delta_is_the_delta",
            "the_soft_argmax_moves_with_the_positions",
        },
    ),
    (
        Target(
            "no mask", soft_argmax=lambda x, p, m: ours("soft_argmax")(x, p, torch.ones_like(m))
        ),
        {
            "the_soft_argmax_is_the_mean_under_the_softmax",
            "what_is_masked_does_not_count",
        },
    ),
    (
        Target("exp", soft_argmax=unguarded_argmax),
        {
            "the_soft_argmax_of_a_delta_is_the_delta",
            "the_soft_argmax_is_finite",
        },
    ),
    (
        Target("uncentred", soft_covariance=uncentred),
        {
            "the_covariance_of_a_delta_is_0",
            "the_covariance_of_two_places_is_their_distance",
            "the_covariance_does_not_know_where_it_is",
        },
    ),
    (
        Target(
            "half the spread", soft_covariance=lambda x, p, m: ours("soft_covariance")(x, p, m) / 2
        ),
        {
            "the_covariance_of_two_places_is_their_distance",
        },
    ),
    (
        Target(
            "spread of the pixel",
            soft_covariance=lambda x, p, m: (
                ours("soft_covariance")(x, p, m) + torch.eye(p.shape[-1]) / 12
            ),
        ),
        {
            "the_covariance_of_a_delta_is_0",
            "the_covariance_of_two_places_is_their_distance",
            "the_covariance_does_not_know_where_it_is",
        },
    ),
    (
        Target("heatmap y, x", heatmap_argmax=heatmap(lambda p, x: p.flip(-1))),
        {
            "the_soft_argmax_of_a_heatmap_peak_is_its_pixel",
            "the_soft_argmax_of_a_heatmap_is_its_mean_pixel",
            "the_soft_argmax_of_a_heatmap_moves_with_it",
        },
    ),
    (
        Target("heatmap from the corner", heatmap_argmax=heatmap(lambda p, x: p + 0.5)),
        {
            "the_soft_argmax_of_a_heatmap_peak_is_its_pixel",
            "the_soft_argmax_of_a_heatmap_is_its_mean_pixel",
        },
    ),
    (
        Target(
            "heatmap normalised",
            heatmap_argmax=heatmap(
                lambda p, x: normalize_pixels(p, image_size=(x.shape[0], x.shape[1]))
            ),
        ),
        {
            "the_soft_argmax_of_a_heatmap_peak_is_its_pixel",
            "the_soft_argmax_of_a_heatmap_is_its_mean_pixel",
            "the_soft_argmax_of_a_heatmap_moves_with_it",
        },
    ),
    (
        Target(
            "heatmap exp",
            heatmap_argmax=heatmap(
                lambda p, x: p / (x.exp().sum() < torch.inf) if x.max() != 1000 else p
            ),
        ),
        {
            "the_soft_argmax_of_a_heatmap_is_finite",
        },
    ),
    (
        Target("last wins", rasterize=in_order),
        {
            "the_nearest_point_wins",
            "the_order_of_points_does_not_count",
        },
    ),
    (
        Target(
            "farthest wins",
            rasterize=lambda p, z, size: torch.nan_to_num(
                1 / ours("rasterize")(p, 1 / z, size), posinf=0
            ),
        ),
        {
            "the_nearest_point_wins",
        },
    ),
    (
        Target("floor", rasterize=lambda p, z, size: ours("rasterize")(p - 0.5, z, size)),
        {
            "the_nearest_point_wins",
        },
    ),
    (
        Target("onto the edge", rasterize=onto_the_edge),
        {
            "the_nearest_point_wins",
            "points_outside_leave_no_trace",
        },
    ),
    (
        Target("into the next row", rasterize=into_the_next_row),
        {"the_nearest_point_wins", "points_outside_leave_no_trace"},
    ),
    (
        Target("depth y, x", rasterize=lambda p, z, size: ours("rasterize")(p.flip(-1), z, size)),
        {
            "the_nearest_point_wins",
            "a_point_at_a_pixels_centre_goes_there",
        },
    ),
    (
        Target(
            "mean of all",
            mean_depth=lambda p, z, w, size: ours("mean_depth")(p, z, torch.ones_like(w), size),
        ),
        {
            "the_mean_is_weighted",
        },
    ),
    (
        Target("unguarded mean", mean_depth=unguarded_mean),
        {
            "depths_that_are_none_leave_no_trace",
        },
    ),
    (
        Target("no depth is nan", mean_depth=nan_where_empty),
        {
            "the_mean_is_weighted",
            "the_order_of_points_does_not_count",
            "points_outside_leave_no_trace",
            "depths_that_are_none_leave_no_trace",
            "depth_images_are_finite",
        },
    ),
    (
        Target(
            "splat from the corner", splat=lambda p, z, w, size: ours("splat")(p + 0.25, z, w, size)
        ),
        {
            "a_splat_keeps_weight_depth_and_place",
            "a_point_at_a_pixels_centre_goes_there",
        },
    ),
    (
        Target("lost weight", splat=lost_weight),
        {
            "a_splat_keeps_weight_depth_and_place",
        },
    ),
    (
        Target("nearest splat", splat=OURS.mean_depth),
        {
            "a_splat_keeps_weight_depth_and_place",
        },
    ),
]


@pytest.mark.parametrize(("target", "wanted"), BROKEN, ids=[target.name for target, _ in BROKEN])
def test_a_wrong_implementation_fails_what_it_should(target: Target, wanted: set[str]) -> None:
    failed = {outcome.invariant for outcome in conformance([target]) if outcome.result == "FAIL"}
    assert failed == wanted


def test_every_invariant_can_fail() -> None:
    flat = {"maps", "scores", "depths"}
    names = {name for name, invariant in INVARIANTS.items() if invariant.scenes in flat}
    assert set().union(*(wanted for _, wanted in BROKEN)) == names
