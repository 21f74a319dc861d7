"""Mistakes that no comparison of numbers says well: shapes, dtypes, chance, changed arguments."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import given
from torch import Tensor
from wrong import OURS, after, before, ours

from deltas_geom.testing import (
    INVARIANTS,
    PosedScene,
    Target,
    seeded_scene,
)
from deltas_geom.testing.answers import SIGNATURES
from deltas_geom.testing.conformance import check, scenes_for
from deltas_geom.testing.strategies import posed_scenes

FIRST = {
    feature: next(name for name, each in INVARIANTS.items() if feature in each.needs)
    for feature in SIGNATURES
    if feature not in ("rasterize", "depth_samples", "pixel_samples")
} | {
    "rasterize": "the_nearest_point_wins",
    "depth_samples": "samples_are_even_in_inverse_depth",
    "pixel_samples": "samples_are_even_in_pixels",
}


def finding(target: Target, feature: str) -> str:
    """What the first invariant of a feature says of the smallest scene."""
    invariant = INVARIANTS[FIRST[feature]]
    with pytest.raises(AssertionError) as caught:
        invariant(target, scenes_for(invariant)[0]())
    return str(caught.value)


def mine(feature: str, change: Callable[..., Any]) -> Target:
    """Ours, but for the change of one answer."""
    changed = getattr(after("mine", feature, change), feature)
    return replace(OURS, name="mine", **{feature: changed})


def writing(feature: str, place: int) -> Target:
    """Ours, but for a number added to an argument afterwards."""

    def call(*given: Any) -> Any:
        found = ours(feature)(*given)
        with torch.no_grad():
            given[place].add_(1)
        return found

    return replace(OURS, name="mine", **{feature: call})


def changed(feature: str, change: Callable[[Any], Any]) -> Target:
    """Ours, but for a change of each real-valued part of the answer."""

    def call(*parts: Any) -> Any:
        found = tuple(change(part) if part.is_floating_point() else part for part in parts)
        return found if len(found) > 1 else found[0]

    return mine(feature, call)


ONE_ARGUMENT = ("heatmap_argmax", 1)
REAL = [feature for feature in SIGNATURES if feature != "judge"]


def test_every_function_of_a_target_has_a_signature() -> None:
    functions = {name for name, value in vars(OURS).items() if callable(value)}
    assert functions == set(SIGNATURES)


@pytest.mark.parametrize(
    ("feature", "place"),
    [(name, place) for name in SIGNATURES for place in (0, 1) if (name, place) != ONE_ARGUMENT],
)
def test_an_argument_that_is_written_into_is_named(feature: str, place: int) -> None:
    wanted = SIGNATURES[feature].split(" -> ")[0].split("; ")[place]
    assert f"mine: {feature} writes into its argument {wanted}" in finding(
        writing(feature, place), feature
    )


@pytest.mark.parametrize("feature", REAL)
def test_an_answer_by_chance_is_called_so(feature: str) -> None:
    by_chance = changed(feature, lambda part: part + 1e-3 * torch.rand(()).to(part))
    assert f"mine: {feature} is not deterministic" in finding(by_chance, feature)


@pytest.mark.parametrize("feature", REAL)
def test_float64_for_all_is_told(feature: str) -> None:
    wide = changed(feature, lambda part: part.double())
    said = finding(wide, feature)
    assert f"mine: {feature} returns " in said
    assert "in float64 for arguments in float32" in said


@pytest.mark.parametrize("feature", SIGNATURES)
def test_a_batch_dim_too_many_is_told_with_the_shapes(feature: str) -> None:
    def call(*parts: Any) -> Any:
        found = tuple(part[None] for part in parts)
        return found if len(found) > 1 else found[0]

    wanted = SIGNATURES[feature].split(" -> ")[1].split("; ")[0]
    assert f"mine: {feature} must return {wanted}, here (" in finding(mine(feature, call), feature)


def test_a_mask_of_numbers_is_told() -> None:
    robust = after("mine", "robust", lambda points, inliers: (points, inliers.double()))
    with pytest.raises(TypeError, match=r"^mine: robust: inliers must be bool, got float64"):
        INVARIANTS["where_no_view_is_wrong_all_are_inliers"](robust, seeded_scene(0))
    judge = after("mine", "judge", lambda status: status.double())
    with pytest.raises(TypeError, match="status must be bool or whole numbers, got float64"):
        INVARIANTS["points_in_front_of_all_cameras_are_valid"](judge, seeded_scene(0))


def test_float32_for_all_that_fails_is_told_of_the_tolerance() -> None:
    single = changed("project", lambda part: part.float())
    outcome = check("pixels_are_those_of_the_camera_equations", single)
    assert outcome.result == "FAIL"
    assert "project returns pixels in float32 for arguments in float64" in outcome.example
    assert "give the target a tolerance, say 3e-3" in outcome.example


def test_a_detached_answer_is_told_of_the_field_that_says_so() -> None:
    detached = after("mine", "triangulate", lambda points: points.detach())
    with pytest.raises(AssertionError, match=r"autograd does not .*differentiable=False"):
        INVARIANTS["gradients_are_finite_differences"](detached, seeded_scene(0))


def test_numpy_under_autograd_is_told_of_that_field_too() -> None:
    inside = after("mine", "project", lambda pixels: torch.from_numpy(pixels.numpy()))
    outcome = check("gradients_of_pixels_are_finite_differences", inside)
    assert "project uses NumPy: give the target differentiable=False" in outcome.example
    assert check("pixels_are_finite", inside).result == "pass"


def test_a_scene_survives_what_writes_into_it() -> None:
    scene = seeded_scene(0)
    with pytest.raises(AssertionError, match="writes into"):
        INVARIANTS["points_are_exact_without_noise"](writing("triangulate", 1), scene)
    assert torch.equal(scene.pixels, seeded_scene(0).pixels)


def test_a_traceback_says_what_was_asked_of_whom() -> None:
    half = after("mine", "rays", lambda rays: rays + 0.5)
    with pytest.raises(AssertionError) as caught:
        INVARIANTS["a_ray_is_seen_at_its_pixel"](half, seeded_scene(0))
    (note,) = caught.value.__notes__
    assert note.startswith("mine: K times the ray of a pixel is the pixel")
    assert "(a_ray_is_seen_at_its_pixel)\n2 views, point (-0.125" in note


def test_a_scene_with_batch_dims_is_told() -> None:
    scene = seeded_scene(0)
    batch = PosedScene(scene.views, scene.points[None], scene.pixels[None])
    fewer = scene._replace(pixels=scene.pixels[:1])
    for wrong in (batch, fewer):
        with pytest.raises(ValueError, match="takes a scene without batch dims: points"):
            INVARIANTS["points_are_exact_without_noise"](OURS, wrong)


@given(scene=posed_scenes(num_views=3))
def test_what_ours_answers_is_in_order(scene: PosedScene) -> None:
    answers = OURS.checked()
    assert answers.project is not None
    pixels = answers.project(scene.views.K, scene.views.cam_from_world, scene.points)
    assert pixels.dtype == torch.float64


@given(scene=posed_scenes())
def test_the_square_of_weights_is_seen_in_two_views_of_any_scene(scene: PosedScene) -> None:
    heeded = INVARIANTS["twice_the_weight_is_a_quarter_of_the_error"]
    heeded(OURS, scene)
    for tolerance in (1e-6, 3e-3):
        for power in (0.0, 0.5):
            wrong = before("mine", "triangulate", lambda p, x, w, power=power: (p, x, w**power))
            with pytest.raises(AssertionError, match=r"^[12]\.?\d* instead of 4 at "):
                heeded(replace(wrong, max_views=2, tolerance=tolerance), scene)


def test_a_function_that_takes_other_arguments_is_told_which_are_given() -> None:
    short = Target("mine", triangulate=lambda proj, pixels: pixels[0])  # type: ignore[arg-type, misc]
    outcome = check("points_are_exact_without_noise", short)
    told = (
        "triangulate is called with 3 arguments: proj (V, 3, 4), pixels (V, N, 2), weights (V, N)"
    )
    assert told in outcome.example


def test_a_type_error_inside_a_function_says_nothing_of_its_arguments() -> None:
    def inside(proj: Tensor, pixels: Tensor, weights: Tensor | None) -> Tensor:
        return str(proj) + 1  # type: ignore[operator, return-value]

    def deeper(proj: Tensor, pixels: Tensor, weights: Tensor | None) -> Tensor:
        return inside(proj, pixels, weights)

    for function in (inside, deeper):
        outcome = check("points_are_exact_without_noise", Target("mine", triangulate=function))
        assert "TypeError" in outcome.example and "is called with" not in outcome.example
