"""Wrong implementations, and the invariants of our testing that find each."""

import pytest
import torch
import wrong_cameras
import wrong_images
import wrong_segments
import wrong_triangulation
from hypothesis import given
from hypothesis import strategies as st
from wrong import OURS, before, ours

from deltas_geom import invert_pose
from deltas_geom.testing import DEGENERATE_SCENES, PosedScene, named_scene
from deltas_geom.testing.agreement import assert_near
from deltas_geom.testing.conformance import conformance, scenes_for
from deltas_geom.testing.invariants import INVARIANTS
from deltas_geom.testing.strategies import posed_scenes
from deltas_geom.testing.target import Target

WRONG = [
    *wrong_cameras.WRONG,
    *wrong_images.WRONG,
    *wrong_segments.WRONG,
    *wrong_triangulation.WRONG,
]
FOUND = {
    "pixels_are_those_of_the_camera_equations": "projected at 0.5 | whole mm",
    "pixels_do_not_know_the_worlds_frame": "whole mm",
    "pixels_follow_a_crop_and_a_resize": "projected at 0.5",
    "gradients_of_pixels_are_finite_differences": (
        "half the gradient | whole mm | unguarded | guarded once"
    ),
    "pixels_are_finite": "unguarded",
    "a_pixel_with_its_depth_is_its_point": "world_from_cam | along the ray | unprojected at 0.5",
    "unprojected_points_move_with_the_world": "world_from_cam",
    "unprojected_points_do_not_know_of_a_crop_and_a_resize": "unprojected at 0.5",
    "a_ray_is_seen_at_its_pixel": "rays at 0.5 | unit rays | rays of K transposed",
    "rays_do_not_know_of_a_crop_and_a_resize": "rays at 0.5 | rays of K transposed",
    "rays_are_finite": "overflowing",
    "a_match_lies_on_its_epipolar_line": "transposed | at the origin | no lines",
    "the_fundamental_matrix_back_is_the_transpose": "at the origin",
    "the_fundamental_matrix_does_not_know_the_worlds_frame": "at the origin",
    "the_fundamental_matrix_follows_a_crop_and_a_resize": "transposed",
    "the_fundamental_matrix_is_finite": "unit F",
    "segment_ends_are_visible_depths_of_the_range": (
        "ends at 0.5 | ends y, x | near first | unclipped | both sides | too long"
    ),
    "every_visible_depth_lies_on_the_segment": (
        "ends at 0.5 | ends y, x | dropped | both sides | not so near | none seen"
    ),
    "a_segment_out_of_sight_is_flagged": (
        "unclipped | both sides | all seen | all seen, a mask | one for all"
    ),
    "without_a_baseline_a_segment_is_a_point": (
        "ends at 0.5 | ends y, x | both sides | all seen | none seen"
    ),
    "a_keypoint_at_the_epipole_stays_there": (
        "ends at 0.5 | ends y, x | both sides | all seen | none seen"
    ),
    "segments_do_not_know_the_worlds_frame": "not so near",
    "segments_follow_a_resize": "ends at 0.5 | ends y, x | unclipped",
    "a_crop_of_the_source_clips_segments": (
        "ends at 0.5 | ends y, x | unclipped | dropped | both sides | all seen | "
        "all seen, a mask | one for all"
    ),
    "segments_are_finite": "empty is nan",
    "samples_are_seen_at_their_inverse_depths": "affine | far samples first",
    "samples_run_from_the_far_to_the_near_end": (
        "from near | far samples first | too wide | unclipped samples"
    ),
    "samples_are_even_in_inverse_depth": "spacings swapped",
    "samples_are_even_in_pixels": "spacings swapped",
    "samples_are_finite": "empty samples are nan",
    "a_sweep_sees_each_inverse_depth_where_it_is": "sees behind | no infinity",
    "a_map_is_read_exactly_at_the_centres_of_its_cells": (
        "aligned corners | map at 0.5 | map y, x | clamped | brighter to the right"
    ),
    "a_linear_field_is_read_exactly": (
        "aligned corners | map at 0.5 | map y, x | nearest cell | clamped | brighter to the right"
    ),
    "reading_follows_a_shift_of_the_map": "aligned corners | map y, x | brighter to the right",
    "reading_is_linear_in_the_map": "clamped | brighter to the right",
    "gradients_of_what_is_read_are_finite_differences": "places detached",
    "what_is_read_is_finite": "unbounded",
    "correlating_is_reading_and_multiplying": "cosine | scaled scores",
    "the_soft_argmax_is_the_mean_under_the_softmax": "half as warm | argmax + 1e-3 | no mask",
    "the_soft_argmax_of_a_delta_is_the_delta": "argmax + 1e-3 | exp",
    "the_soft_argmax_moves_with_the_positions": "argmax + 1e-3",
    "what_is_masked_does_not_count": "no mask",
    "the_soft_argmax_is_finite": "exp",
    "gradients_of_the_soft_argmax_are_finite_differences": "logits detached",
    "the_covariance_of_a_delta_is_0": "uncentred | spread of the pixel",
    "the_covariance_of_two_places_is_their_distance": (
        "uncentred | half the spread | spread of half | spread of the pixel"
    ),
    "the_covariance_does_not_know_where_it_is": "uncentred | by squares | spread of the pixel",
    "what_is_masked_has_no_spread": "spread of all | uncentred",
    "the_soft_argmax_of_a_heatmap_peak_is_its_pixel": (
        "heatmap y, x | heatmap from the corner | heatmap normalised"
    ),
    "the_soft_argmax_of_a_heatmap_is_its_mean_pixel": (
        "heatmap y, x | heatmap from the corner | heatmap normalised"
    ),
    "the_soft_argmax_of_a_heatmap_moves_with_it": "heatmap y, x | heatmap normalised",
    "the_soft_argmax_of_a_heatmap_is_finite": "heatmap exp",
    "points_are_exact_without_noise": "1 mm off | pixels stretched | spread",
    "points_move_with_the_world": "1 mm off | svd | normal equations",
    "points_do_not_know_of_a_crop_and_a_resize": "pixels stretched",
    "points_do_not_know_the_order_of_views": "first view twice",
    "many_points_are_solved_as_each_alone": "spread",
    "only_the_ratios_of_weights_count": "weights plus 0.1",
    "a_view_of_weight_0_is_a_view_removed": "weights ignored | weights plus 0.1",
    "a_doubled_view_is_a_doubled_squared_weight": "weights ignored | weights plus 0.1",
    "twice_the_weight_is_a_quarter_of_the_error": (
        "weights ignored | weights ignored, pair | weights not squared | weights plus 0.1 | "
        "1 mm off | pixels stretched"
    ),
    "a_batch_of_scenes_is_solved_as_each_alone": "first of batch | first camera of batch",
    "float32_is_as_good_as_rounding_the_input": "float16",
    "gradients_are_finite_differences": "no gradient",
    "gradients_are_finite_differences_at_ties": "no gradient | svd | normal equations",
    "points_are_finite": "svd | normal equations",
    "gradients_are_finite": "svd | normal equations",
    "the_status_is_what_the_geometry_says": "all valid | none valid | any reason",
    "points_in_front_of_all_cameras_are_valid": "none valid",
    "mirrored_points_are_behind": "all valid | any reason",
    "a_pixel_that_is_nan_spoils_its_point_alone": (
        "all valid | none valid | any reason | all or none"
    ),
    "one_view_is_too_few": "all valid | weights not judged",
    "a_view_of_weight_0_may_be_nan": "none valid | weights not judged",
    "refined_points_fit_no_worse": "overshot | random walk",
    "an_exact_point_is_not_moved": "random walk",
    "an_exact_point_has_no_residual": "residual at 0.5",
    "the_residual_is_the_rms_distance_in_pixels": "in slopes | mean | algebraic | residual at 0.5",
    "the_residual_does_not_know_the_worlds_frame": "algebraic",
    "the_parallax_is_the_largest_angle_between_rays": (
        "degrees | baseline | from the first | acute"
    ),
    "the_parallax_does_not_know_the_worlds_frame": "baseline",
    "where_no_view_is_wrong_all_are_inliers": "none right | robust, 1 mm off",
    "a_wrong_view_does_not_move_a_robust_point": (
        "all views | no second look | none right | robust, 1 mm off"
    ),
    "a_view_of_weight_0_does_not_move_a_robust_point": "robust, no weights | robust, 1 mm off",
    "inliers_are_within_the_threshold": "all views | squared px",
    "robust_points_move_with_the_world": "robust, 1 mm off",
    "a_pixel_that_is_nan_moves_no_other_point": (
        "weights ignored | weights plus 0.1 | spread | all or nothing | svd | normal equations | "
        "robust, no weights"
    ),
    "no_point_beside_fits_better": (
        "overshot | no step | random walk | robust, no weights | any weight | robust, 1 mm off"
    ),
    "the_nearest_point_wins": (
        "last wins | farthest wins | floor | onto the edge | into the next row | depth y, x"
    ),
    "the_mean_is_weighted": "mean of all | no depth is nan",
    "a_splat_keeps_weight_depth_and_place": "splat from the corner | lost weight | nearest splat",
    "the_order_of_points_does_not_count": "last wins | no depth is nan",
    "a_point_at_a_pixels_centre_goes_there": "depth y, x | splat from the corner",
    "points_outside_leave_no_trace": (
        "onto the edge | into the next row | nan at 0 | no depth is nan"
    ),
    "depths_that_are_none_leave_no_trace": "unguarded mean | no depth is nan",
    "depth_images_are_finite": "no depth is nan",
}
"""By invariant, those of the above that fail it; they pass all others."""
FAIL = {invariant: {*names.split(" | ")} for invariant, names in FOUND.items()}


def failures(target: Target) -> set[str]:
    return {outcome.invariant for outcome in conformance([target]) if outcome.result == "FAIL"}


@pytest.mark.parametrize("target", WRONG, ids=[target.name for target in WRONG])
def test_a_wrong_implementation_fails_what_it_should(target: Target) -> None:
    assert failures(target) == {name for name, wrong in FAIL.items() if target.name in wrong}


def test_a_name_of_no_invariant_is_told_with_the_nearest() -> None:
    with pytest.raises(KeyError, match="did you mean 'points_are_finite'"):
        INVARIANTS["points_are_fnite"]


def test_every_invariant_can_fail() -> None:
    assert INVARIANTS.keys() == FAIL.keys()
    assert set().union(*FAIL.values()) == {target.name for target in WRONG}


# The most classic mistakes, in all that are given cameras: K, of all their views.
TAKE_K = ("project", "fundamental", "segments", "depth_samples", "pixel_samples", "sweep")
TAKE_K += ("unproject", "rays")


@pytest.mark.parametrize("feature", TAKE_K)
def test_the_anchors_K_in_all_views_is_found(feature: str) -> None:
    assert failures(before("K", feature, lambda K, *others: (K[:1].expand_as(K), *others)))


@pytest.mark.parametrize("feature", TAKE_K[:-1])
def test_inverted_poses_are_found(feature: str) -> None:
    assert failures(before("poses", feature, lambda K, t, *others: (K, invert_pose(t), *others)))


@pytest.mark.parametrize("feature", ["triangulate", "refine", "robust"])
def test_half_a_pixel_is_found(feature: str) -> None:
    assert failures(before("0.5", feature, lambda proj, x, *others: (proj, x + 0.5, *others)))


FEATURES = {"unproject", "rays", "residual", "parallax", "robust", "points", "fit"}
OF_CAMERAS = [name for name, each in INVARIANTS.items() if FEATURES & {*each.needs}]


@given(scene=posed_scenes(num_views=3, num_points=2), shift=st.sampled_from([0.0, 0.5]))
@pytest.mark.parametrize("name", [n for n in OF_CAMERAS if INVARIANTS[n].scenes == "posed"])
def test_deltas_passes_on_drawn_scenes(name: str, scene: PosedScene, shift: float) -> None:
    INVARIANTS[name](OURS, scene._replace(pixels=scene.pixels + shift))


def test_no_two_views_of_a_fixed_scene_share_a_camera() -> None:
    for invariant in INVARIANTS.values():
        for make in scenes_for(invariant):
            scene = make()
            if isinstance(scene, PosedScene):
                K = scene.views.K
                differ = (K[:, None] != K).any(dim=-1).any(dim=-1)
                assert bool((differ | torch.eye(len(K)).bool()).all())


@pytest.mark.parametrize("name", DEGENERATE_SCENES)
def test_a_named_scene_is_seen_by_its_cameras(name: str) -> None:
    scene, alike = named_scene(name), DEGENERATE_SCENES[name]()
    rays = [ours("rays")(seen.views.K, seen.pixels) for seen in (scene, alike)]
    assert_near(rays[0], rays[1], 1e-12, "(slope)")
    assert torch.equal(scene.pixels[0], alike.pixels[0])
    with pytest.raises(ValueError, match=r"^name must be one of zero_baseline, .*, got 'star'$"):
        named_scene("star")
