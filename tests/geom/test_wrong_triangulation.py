"""Wrong projections and triangulations, each with exactly what it fails."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from deltas_geom import PosedViews, triangulate_points
from deltas_geom.epipolar.fundamental import cross_matrix, inverse_intrinsics
from deltas_geom.testing.conformance import conformance
from deltas_geom.testing.invariants import INVARIANTS
from deltas_geom.testing.target import ImageSize, Target
from deltas_geom.testing.targets import deltas

OURS = deltas()
Size = ImageSize
FEATURES = {"project", "fundamental", "triangulate", "gradients", "batches", "judge", "refine"}


def ours(feature: str) -> Callable[..., Any]:
    function: Callable[..., Any] = getattr(OURS, feature)
    return function


def heavier(proj: Tensor, pixels: Tensor, weights: Tensor | None) -> Tensor:
    assert weights is not None
    return triangulate_points(proj, pixels, weights + 0.1)


def svd_points(proj: Tensor, pixels: Tensor, weights: Tensor | None) -> Tensor:
    """In the world's frame, as in the book."""
    rows = pixels[..., None] * proj[:, None, 2:] - proj[:, None, :2]
    rows = rows if weights is None else weights[..., None, None] * rows
    null: Tensor = torch.linalg.svd(rows.transpose(0, 1).flatten(1, 2)).Vh[:, -1]
    return null[:, :3] / null[:, 3:]


def first_view_counts_twice(proj: Tensor, pixels: Tensor, weights: Tensor | None) -> Tensor:
    assert weights is not None
    return triangulate_points(proj, pixels, torch.cat([2 * weights[:1], weights[1:]]))


def spread(proj: Tensor, pixels: Tensor, weights: Tensor | None) -> Tensor:
    points = triangulate_points(proj, pixels, weights)
    return points + 1e-3 * (points - points.mean(dim=0))


def constant(proj: Tensor, pixels: Tensor, weights: Tensor | None) -> Tensor:
    points = triangulate_points(proj, pixels, weights)
    return points.detach() + 0 * points


def unguarded_pixels(K: Tensor, cam_from_world: Tensor, points: Tensor) -> Tensor:
    homogeneous = torch.nn.functional.pad(points, (0, 1), value=1.0)
    seen = homogeneous @ PosedViews(K, cam_from_world).proj.mT
    return seen[..., :2] / seen[..., 2:]


def fundamental_of_a_first_view_at_the_origin(K: Tensor, cam_from_world: Tensor) -> Tensor:
    essential = cross_matrix(cam_from_world[1, :3, 3]) @ cam_from_world[1, :3, :3]
    return inverse_intrinsics(K[1]).mT @ essential @ inverse_intrinsics(K[0])


def unit_fundamental(K: Tensor, cam_from_world: Tensor) -> Tensor:
    fundamental = ours("fundamental")(K, cam_from_world)
    unit: Tensor = fundamental / fundamental.norm()
    return unit


def status(change: Callable[[Tensor], Tensor]) -> Callable[..., Tensor]:
    return lambda proj, x, w: change(ours("judge")(proj, x, w))


def any_weight(proj: Tensor, x: Tensor, w: Tensor | None) -> Tensor:
    return ours("judge")(proj, x, None if w is None else torch.ones_like(w))


def all_or_none(proj: Tensor, x: Tensor, w: Tensor | None) -> Tensor:
    found = ours("judge")(proj, x, w)
    return found.max().expand_as(found)


def normal_equations(proj: Tensor, pixels: Tensor, weights: Tensor | None) -> Tensor:
    """The null vector of A^T A in the input's precision, in the world's frame."""
    rows = pixels[..., None] * proj[:, None, 2:] - proj[:, None, :2]
    rows = rows if weights is None else weights[..., None, None] * rows
    rows = rows.transpose(0, 1).flatten(1, 2)
    null = torch.linalg.eigh(rows.mT @ rows).eigenvectors[..., 0]
    return null[:, :3] / null[:, 3:]


def first_of_batch(proj: Tensor, pixels: Tensor, weights: Tensor | None) -> Tensor:
    found = triangulate_points(proj, pixels, weights)
    return found[..., :1, :, :].expand_as(found) if found.dim() > 2 else found


def overshot(proj: Tensor, x: Tensor, points: Tensor, w: Tensor | None) -> Tensor:
    return points + 2.5 * (ours("refine")(proj, x, points, w) - points)


BROKEN: list[tuple[Target, set[str]]] = [
    (
        Target(
            "1 mm off",
            differentiable=False,
            triangulate=lambda p, x, w: triangulate_points(p, x, w) + 1e-3,
        ),
        {
            "points_are_exact_without_noise",
            "points_move_with_the_world",
        },
    ),
    (
        Target(
            "weights ignored",
            differentiable=False,
            triangulate=lambda p, x, w: triangulate_points(p, x),
        ),
        {
            "a_view_of_weight_0_is_a_view_removed",
            "a_doubled_view_is_a_doubled_squared_weight",
        },
    ),
    (
        Target("weights plus 0.1", differentiable=False, triangulate=heavier),
        {
            "only_the_ratios_of_weights_count",
            "a_view_of_weight_0_is_a_view_removed",
            "a_doubled_view_is_a_doubled_squared_weight",
        },
    ),
    (
        Target(
            "pixels stretched",
            differentiable=False,
            triangulate=lambda p, x, w: triangulate_points(p, 1.001 * x, w),
        ),
        {
            "points_are_exact_without_noise",
            "points_do_not_know_of_a_crop_and_a_resize",
        },
    ),
    (
        Target("first view twice", differentiable=False, triangulate=first_view_counts_twice),
        {
            "points_do_not_know_the_order_of_views",
        },
    ),
    (
        Target("spread", differentiable=False, triangulate=spread),
        {
            "points_are_exact_without_noise",
            "many_points_are_solved_as_each_alone",
        },
    ),
    (
        Target("no gradient", triangulate=constant),
        {
            "gradients_are_finite_differences",
            "gradients_are_finite_differences_at_ties",
        },
    ),
    (
        Target("svd", triangulate=lambda p, x, w: svd_points(p, x, w) + 0 / (p[0] - p[1]).norm()),
        {
            "points_move_with_the_world",
            "gradients_are_finite_differences_at_ties",
            "points_are_finite",
            "gradients_are_finite",
        },
    ),
    (
        Target("transposed", fundamental=lambda k, t: ours("fundamental")(k, t).mT),
        {
            "a_match_lies_on_its_epipolar_line",
            "the_fundamental_matrix_follows_a_crop_and_a_resize",
        },
    ),
    (
        Target("at the origin", fundamental=fundamental_of_a_first_view_at_the_origin),
        {
            "a_match_lies_on_its_epipolar_line",
            "the_fundamental_matrix_back_is_the_transpose",
            "the_fundamental_matrix_does_not_know_the_worlds_frame",
        },
    ),
    (
        Target("unit F", fundamental=unit_fundamental),
        {
            "the_fundamental_matrix_is_finite",
        },
    ),
    (
        Target("no lines", fundamental=lambda k, t: 0 * ours("fundamental")(k, t)),
        {
            "a_match_lies_on_its_epipolar_line",
        },
    ),
    (
        Target("centres at 0.5", project=lambda k, t, x: ours("project")(k, t, x) + 0.5),
        {
            "pixels_are_those_of_the_camera_equations",
            "pixels_follow_a_crop_and_a_resize",
        },
    ),
    (
        Target("whole mm", project=lambda k, t, x: ours("project")(k, t, (1e3 * x).round() / 1e3)),
        {
            "pixels_are_those_of_the_camera_equations",
            "pixels_do_not_know_the_worlds_frame",
        },
    ),
    (
        Target("unguarded", project=unguarded_pixels),
        {
            "pixels_are_finite",
        },
    ),
    (
        Target("all valid", judge=status(lambda s: 0 * s)),
        {
            "the_status_is_what_the_geometry_says",
            "mirrored_points_are_behind",
            "a_pixel_that_is_nan_spoils_its_point_alone",
            "one_view_is_too_few",
        },
    ),
    (
        Target("none valid", judge=status(lambda s: s > 9)),
        {
            "the_status_is_what_the_geometry_says",
            "points_in_front_of_all_cameras_are_valid",
            "a_pixel_that_is_nan_spoils_its_point_alone",
            "a_view_of_weight_0_may_be_nan",
        },
    ),
    (
        Target("any reason", judge=status(lambda s: s.clamp(max=1))),
        {
            "the_status_is_what_the_geometry_says",
            "mirrored_points_are_behind",
            "a_pixel_that_is_nan_spoils_its_point_alone",
        },
    ),
    (
        Target("weights not judged", judge=any_weight),
        {
            "one_view_is_too_few",
            "a_view_of_weight_0_may_be_nan",
        },
    ),
    (
        Target("all or none", judge=all_or_none),
        {
            "a_pixel_that_is_nan_spoils_its_point_alone",
        },
    ),
    (
        Target("overshot", refine=overshot),
        {
            "refined_points_fit_no_worse",
        },
    ),
    (
        Target("random walk", refine=lambda proj, x, points, w: points + 1e-4),
        {
            "refined_points_fit_no_worse",
            "an_exact_point_is_not_moved",
        },
    ),
    (
        Target("first of batch", differentiable=False, triangulate=first_of_batch, batched=True),
        {
            "a_batch_of_scenes_is_solved_as_each_alone",
        },
    ),
    (
        Target(
            "float16",
            differentiable=False,
            triangulate=lambda p, x, w: (
                triangulate_points(p, x, w).half().to(x.dtype)
                if x.dtype == torch.float32
                else triangulate_points(p, x, w)
            ),
        ),
        {
            "float32_is_as_good_as_rounding_the_input",
        },
    ),
    (
        Target("normal equations", triangulate=normal_equations),
        {
            "points_move_with_the_world",
            "gradients_are_finite_differences_at_ties",
            "points_are_finite",
            "gradients_are_finite",
        },
    ),
]


@pytest.mark.parametrize(("target", "wanted"), BROKEN, ids=[target.name for target, _ in BROKEN])
def test_a_wrong_implementation_fails_what_it_should(target: Target, wanted: set[str]) -> None:
    failed = {outcome.invariant for outcome in conformance([target]) if outcome.result == "FAIL"}
    assert failed == wanted


def test_every_invariant_can_fail() -> None:
    names = {name for name, invariant in INVARIANTS.items() if FEATURES & {*invariant.needs}}
    assert set().union(*(wanted for _, wanted in BROKEN)) == names
