"""Wrong cameras: what is unprojected, measured and rejected with one mistake, and what it fails."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from deltas_geom import invert_pose
from deltas_geom.testing import DEGENERATE_SCENES, PosedScene, named_scene
from deltas_geom.testing.agreement import assert_near
from deltas_geom.testing.conformance import conformance, scenes_for
from deltas_geom.testing.invariants import INVARIANTS
from deltas_geom.testing.strategies import posed_scenes
from deltas_geom.testing.target import Target
from deltas_geom.testing.targets import deltas

OURS = deltas()
FEATURES = {"unproject", "rays", "residual", "parallax", "robust"}
OF_CAMERAS = [
    name
    for name in INVARIANTS
    if FEATURES & {*INVARIANTS[name].needs} and INVARIANTS[name].scenes == "posed"
]
# Functions that are given K, of all their views.
TAKE_K = (
    "project",
    "fundamental",
    "segments",
    "depth_samples",
    "pixel_samples",
    "sweep",
    "unproject",
    "rays",
)


def ours(feature: str) -> Callable[..., Any]:
    function: Callable[..., Any] = getattr(OURS, feature)
    return function


def failures(target: Target) -> set[str]:
    return {outcome.invariant for outcome in conformance([target]) if outcome.result == "FAIL"}


def along_the_ray(K: Tensor, pose: Tensor, pixels: Tensor, depth: Tensor) -> Tensor:
    rays = ours("rays")(K, pixels)
    points: Tensor = ours("unproject")(K, pose, pixels, depth / rays.norm(dim=-1))
    return points


def in_normalised_units(proj: Tensor, pixels: Tensor, points: Tensor, w: Tensor | None) -> Tensor:
    """Divided by the mean focal length, as if pixels were slopes."""
    residual: Tensor = ours("residual")(proj, pixels, points, w) / 500
    return residual


def of_the_mean(proj: Tensor, pixels: Tensor, points: Tensor, w: Tensor | None) -> Tensor:
    """The mean distance instead of the root of the mean square."""
    alone = [
        ours("residual")(proj[v : v + 1], pixels[v : v + 1], points, None)
        for v in range(proj.shape[0])
    ]
    weights = torch.ones_like(pixels[..., 0]) if w is None else w.square()
    mean: Tensor = (weights * torch.stack(alone)).sum(dim=0) / weights.sum(dim=0)
    return mean


def in_the_frame_of_the_world(
    proj: Tensor, pixels: Tensor, points: Tensor, w: Tensor | None
) -> Tensor:
    """Not divided by the depth: 0 where it should be, and else in metres times pixels."""
    seen = torch.nn.functional.pad(points, (0, 1), value=1.0) @ proj.mT
    offset = seen[..., :2] - pixels * seen[..., 2:]
    return offset.square().sum(dim=-1).mean(dim=0).sqrt()


def robust(change: Callable[..., tuple[Tensor, Tensor]]) -> Callable[..., tuple[Tensor, Tensor]]:
    def call(proj: Tensor, pixels: Tensor, w: Tensor | None, limit: float) -> Any:
        return change(*ours("robust")(proj, pixels, w, limit))

    return call


def all_views(proj: Tensor, pixels: Tensor, w: Tensor | None, limit: float) -> Any:
    points = ours("triangulate")(proj, pixels, w)
    return points, torch.ones_like(pixels[..., 0]).bool()


def strict(proj: Tensor, pixels: Tensor, w: Tensor | None, limit: float) -> Any:
    """The inliers of the DLT of all views: one wrong view spoils the point for all."""
    points = ours("triangulate")(proj, pixels, w)
    seen = torch.nn.functional.pad(points, (0, 1), value=1.0) @ proj.mT
    return points, (seen[..., :2] / seen[..., 2:] - pixels).norm(dim=-1) < limit


BROKEN: list[tuple[Target, set[str]]] = [
    (
        Target(
            "world_from_cam",
            unproject=lambda k, t, x, z: ours("unproject")(k, invert_pose(t), x, z),
        ),
        {"a_pixel_with_its_depth_is_its_point", "unprojected_points_move_with_the_world"},
    ),
    (
        Target("along the ray", unproject=along_the_ray),
        {"a_pixel_with_its_depth_is_its_point"},
    ),
    (
        Target("centres at 0.5", unproject=lambda k, t, x, z: ours("unproject")(k, t, x + 0.5, z)),
        {
            "a_pixel_with_its_depth_is_its_point",
            "unprojected_points_do_not_know_of_a_crop_and_a_resize",
        },
    ),
    (
        Target("rays at 0.5", rays=lambda k, x: ours("rays")(k, x + 0.5)),
        {"a_ray_is_seen_at_its_pixel", "rays_do_not_know_of_a_crop_and_a_resize"},
    ),
    (
        Target(
            "unit rays", rays=lambda k, x: torch.nn.functional.normalize(ours("rays")(k, x), dim=-1)
        ),
        {"a_ray_is_seen_at_its_pixel"},
    ),
    (
        Target("rays of K transposed", rays=lambda k, x: torch.linalg.solve(k.mT, pad(x).mT).mT),
        {"a_ray_is_seen_at_its_pixel", "rays_do_not_know_of_a_crop_and_a_resize"},
    ),
    (
        Target("overflowing", rays=lambda k, x: ours("rays")(k, x) / (x.abs() < 1e12).all()),
        {"rays_are_finite"},
    ),
    (
        Target("normalised", residual=in_normalised_units),
        {"the_residual_is_the_rms_distance_in_pixels"},
    ),
    (
        Target("mean", residual=of_the_mean),
        {"the_residual_is_the_rms_distance_in_pixels"},
    ),
    (
        Target("algebraic", residual=in_the_frame_of_the_world),
        {
            "the_residual_is_the_rms_distance_in_pixels",
            "the_residual_does_not_know_the_worlds_frame",
        },
    ),
    (
        Target("residual at 0.5", residual=lambda p, x, X, w: ours("residual")(p, x + 0.5, X, w)),
        {"an_exact_point_has_no_residual", "the_residual_is_the_rms_distance_in_pixels"},
    ),
    (
        Target("degrees", parallax=lambda p, x: ours("parallax")(p, x).rad2deg()),
        {"the_parallax_is_the_largest_angle_between_rays"},
    ),
    (
        Target("baseline", parallax=lambda p, x: 0 * ours("parallax")(p, x) + baseline(p)),
        {
            "the_parallax_is_the_largest_angle_between_rays",
            "the_parallax_does_not_know_the_worlds_frame",
        },
    ),
    (
        Target("all views", robust=all_views),
        {"a_wrong_view_does_not_move_a_robust_point", "inliers_are_within_the_threshold"},
    ),
    (
        Target("no second look", robust=strict),
        {"a_wrong_view_does_not_move_a_robust_point"},
    ),
    (
        Target("none right", robust=robust(lambda points, inliers: (points, inliers & False))),
        {"where_no_view_is_wrong_all_are_inliers", "a_wrong_view_does_not_move_a_robust_point"},
    ),
    (
        Target("robust, 1 mm off", robust=robust(lambda points, inliers: (points + 1e-3, inliers))),
        {
            "where_no_view_is_wrong_all_are_inliers",
            "a_wrong_view_does_not_move_a_robust_point",
            "robust_points_move_with_the_world",
        },
    ),
]


def pad(pixels: Tensor) -> Tensor:
    return torch.nn.functional.pad(pixels, (0, 1), value=1.0)


def baseline(proj: Tensor) -> Tensor:
    centers = -torch.linalg.solve(proj[..., :3], proj[..., 3])
    return (centers[1:] - centers[:1]).norm(dim=-1).amax()


@pytest.mark.parametrize(("target", "wanted"), BROKEN, ids=[target.name for target, _ in BROKEN])
def test_a_wrong_implementation_fails_what_it_should(target: Target, wanted: set[str]) -> None:
    assert failures(target) == wanted


def test_every_invariant_can_fail() -> None:
    names = {name for name, invariant in INVARIANTS.items() if FEATURES & {*invariant.needs}}
    assert set().union(*(wanted for _, wanted in BROKEN)) == names


@given(scene=posed_scenes(num_views=3, num_points=2), shift=st.sampled_from([0.0, 0.5]))
@pytest.mark.parametrize("name", OF_CAMERAS)
def test_deltas_passes_on_drawn_scenes(name: str, scene: PosedScene, shift: float) -> None:
    INVARIANTS[name](OURS, scene._replace(pixels=scene.pixels + shift))


# The most classic mistakes, in all that are given cameras.


@pytest.mark.parametrize("feature", TAKE_K)
def test_the_anchors_K_in_all_views_is_found(feature: str) -> None:
    def one_camera(K: Tensor, *others: Any) -> Any:
        return ours(feature)(K[:1].expand_as(K), *others)

    assert failures(Target("anchor's K", **{feature: one_camera}))  # type: ignore[arg-type]


@pytest.mark.parametrize("feature", [name for name in TAKE_K if name != "rays"])
def test_inverted_poses_are_found(feature: str) -> None:
    def inverted(K: Tensor, pose: Tensor, *others: Any) -> Any:
        return ours(feature)(K, invert_pose(pose), *others)

    assert failures(Target("world_from_cam", **{feature: inverted}))  # type: ignore[arg-type]


@pytest.mark.parametrize("feature", ["triangulate", "refine", "robust"])
def test_half_a_pixel_is_found(feature: str) -> None:
    def shifted(proj: Tensor, pixels: Tensor, *others: Any) -> Any:
        return ours(feature)(proj, pixels + 0.5, *others)

    assert failures(Target("half a pixel", **{feature: shifted}))  # type: ignore[arg-type]


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
