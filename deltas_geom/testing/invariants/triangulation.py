"""Invariants of triangulation, with weights where the target heeds them."""

import torch
from torch import Tensor

from deltas_geom.cameras.poses import invert_pose
from deltas_geom.cameras.projection import project
from deltas_geom.testing.agreement import (
    EXTREMES,
    POINT_TOLERANCE,
    assert_finite,
    assert_gradients,
    assert_near,
    gradients,
    slack,
)
from deltas_geom.testing.changes import ELSEWHERE, World, cut, transformed
from deltas_geom.testing.registry import first_views, invariant
from deltas_geom.testing.scenes import PosedScene
from deltas_geom.testing.target import Target


@invariant("triangulate")
def points_are_exact_without_noise(
    target: Target, scene: PosedScene, *, weights: Tensor | None = None
) -> None:
    """The pixels of a point give the point."""
    exact = scene._replace(pixels=project(scene.views, scene.points).pixels)
    found = points_of(target, exact, weights_for(target, scene, weights))
    assert_near(found, scene.points, POINT_TOLERANCE, "m", "point")


@invariant("triangulate")
def points_move_with_the_world(
    target: Target, scene: PosedScene, *, weights: Tensor | None = None, world: World = ELSEWHERE
) -> None:
    """Where cameras are moved, turned and scaled, the points of noisy pixels go with them."""
    weights = weights_for(target, scene, weights)
    moved = points_of(target, scene._replace(views=world.views(scene.views)), weights)
    back = World(invert_pose(world.new_from_world), 1.0).points(moved / world.scale)
    assert_near(back, points_of(target, scene, weights), POINT_TOLERANCE, "m", "point")


@invariant("triangulate")
def points_do_not_know_of_a_crop_and_a_resize(
    target: Target, scene: PosedScene, *, weights: Tensor | None = None
) -> None:
    """Points stay when each image is cropped anywhere and all are halved."""
    weights = weights_for(target, scene, weights)
    change = cut(scene.views, new_size=(240, 320))
    views = scene.views._replace(K=change @ scene.views.K)
    halved = PosedScene(views, scene.points, transformed(change, scene.pixels))
    assert_near(
        points_of(target, halved, weights),
        points_of(target, scene, weights),
        POINT_TOLERANCE,
        "m",
        "point",
    )


@invariant("triangulate")
def points_do_not_know_the_order_of_views(
    target: Target,
    scene: PosedScene,
    *,
    weights: Tensor | None = None,
    order: list[int] | None = None,
) -> None:
    """Points stay when the views are permuted (here: reversed)."""
    weights = weights_for(target, scene, weights)
    order = order or list(reversed(range(scene.views.num_views)))
    permuted = scene._replace(views=scene.views.select(order), pixels=scene.pixels[order])
    found = points_of(target, permuted, None if weights is None else weights[order])
    assert_near(found, points_of(target, scene, weights), POINT_TOLERANCE, "m", "point")


@invariant("triangulate")
def many_points_are_solved_as_each_alone(
    target: Target, scene: PosedScene, *, weights: Tensor | None = None
) -> None:
    """A batch of points gives what the points give one at a time."""
    weights = weights_for(target, scene, weights)
    alone = []
    for point in range(scene.points.shape[0]):
        one = slice(point, point + 1)
        single = scene._replace(pixels=scene.pixels[:, one])
        alone.append(points_of(target, single, None if weights is None else weights[:, one]))
    assert_near(points_of(target, scene, weights), torch.cat(alone), POINT_TOLERANCE, "m", "point")


@invariant("triangulate", "weights")
def only_the_ratios_of_weights_count(
    target: Target, scene: PosedScene, *, weights: Tensor | None = None, factor: float = 7.0
) -> None:
    """Points stay when all weights are multiplied by one factor."""
    weights = weights_for(target, scene, weights)
    assert weights is not None
    found = points_of(target, scene, factor * weights)
    assert_near(found, points_of(target, scene, weights), POINT_TOLERANCE, "m", "point")


@invariant("triangulate", "weights", "many views")
def a_view_of_weight_0_is_a_view_removed(
    target: Target,
    scene: PosedScene,
    *,
    weights: Tensor | None = None,
    view: int = -1,
    spoil: float = 100.0,
) -> None:
    """A view of weight 0 changes nothing, wherever its pixels lie (moved by ``spoil`` px).

    The scene has three views or more.
    """
    weights = weights_for(target, scene, weights)
    assert weights is not None
    rest = [other for other in range(scene.views.num_views) if other != view % weights.shape[0]]
    removed = scene._replace(views=scene.views.select(rest), pixels=scene.pixels[rest])
    spoiled, without = scene.pixels.clone(), weights.clone()
    spoiled[view] += spoil
    without[view] = 0
    found = points_of(target, scene._replace(pixels=spoiled), without)
    assert_near(found, points_of(target, removed, weights[rest]), POINT_TOLERANCE, "m", "point")


@invariant("triangulate", "weights", "many views")
def a_doubled_view_is_a_doubled_squared_weight(
    target: Target, scene: PosedScene, *, weights: Tensor | None = None
) -> None:
    """A view given twice counts as once with its weights times the square root of 2."""
    pair = first_views(scene, 2)
    weights = weights_for(target, pair, None if weights is None else weights[:2])
    assert weights is not None
    twice = [0, 1, 1]
    doubled = pair._replace(views=pair.views.select(twice), pixels=pair.pixels[twice])
    heavier = weights * torch.tensor([1.0, 2**0.5], dtype=weights.dtype)[:, None]
    found = points_of(target, doubled, weights[twice])
    assert_near(found, points_of(target, pair, heavier), POINT_TOLERANCE, "m", "point")


@invariant("triangulate", "weights")
def twice_the_weight_is_a_quarter_of_the_error(target: Target, scene: PosedScene) -> None:
    """With weights 2 and 1, not 1 and 1, the errors in px of two views have 4 times the ratio."""
    pair = first_views(scene, 2)
    pixels = project(pair.views, pair.points).pixels
    # Cameras of scenes stand beside each other: the pixel leaves its epipolar line. So far that
    # points a few mm off, of a target in float32, are beside it as nothing.
    pixels[1, :, 1] += 32.0

    def ratio(heavier: float) -> Tensor:
        weights = torch.ones_like(pixels[..., 0])
        weights[0] = heavier
        points = points_of(target, pair._replace(pixels=pixels), weights)
        first, second = (project(pair.views, points).pixels - pixels).norm(dim=-1)
        quotient: Tensor = second / first
        return quotient

    found = ratio(2.0) / ratio(1.0)
    # It is 4 but for 0.03 of curvature; 2 if weights are not squared, 1 if ignored. The tolerance
    # of points, 1 um, is 3e-4 px, beside errors of 6 to 26 px.
    assert_near(found, torch.full_like(found, 4.0), 0.1 / slack() + 5e-4, "(squared weight)")


@invariant("batches")
def a_batch_of_scenes_is_solved_as_each_alone(target: Target, scene: PosedScene) -> None:
    """Leading batch dims of cameras, pixels and weights broadcast against each other."""
    assert target.triangulate is not None
    weights = weights_for(target, scene, None)
    pixels = torch.stack([scene.pixels, scene.pixels + 0.5])
    moved = scene._replace(views=ELSEWHERE.views(scene.views))
    proj = torch.stack([scene.views.proj, moved.views.proj])
    many = None if weights is None else torch.stack([weights, 2 * weights.flip(0), weights**2])
    found = target.triangulate(proj[:, None, None], pixels[:, None], many)
    count = 1 if many is None else 3
    alone = [
        points_of(target, each._replace(pixels=pixels[i]), None if many is None else many[j])
        for each in (scene, moved)
        for i in range(2)
        for j in range(count)
    ]
    wanted = torch.stack(alone).reshape(2, 2, count, *alone[0].shape)
    assert_near(found, wanted, POINT_TOLERANCE, "m")


@invariant("triangulate")
def float32_is_as_good_as_rounding_the_input(
    target: Target, scene: PosedScene, *, weights: Tensor | None = None, roundings: int = 128
) -> None:
    """In float32, points are off by no more than 128 roundings of cameras and pixels move them.

    How far one rounding of every entry, up or down, moves them is tried in the target's own
    float64.
    """
    weights = weights_for(target, scene, weights)
    single = [scene.views.proj.float(), scene.pixels.float()]

    def solve(proj: Tensor, pixels: Tensor) -> Tensor:
        assert target.triangulate is not None
        heeded = None if weights is None else weights.to(proj.dtype)
        return target.triangulate(proj, pixels, heeded).detach().double()

    wanted = solve(*(value.double() for value in single))
    effect = wanted.abs()
    generator = torch.Generator().manual_seed(0)
    for _ in range(8):
        signs = (torch.randint(0, 2, value.shape, generator=generator) for value in single)
        # A step large enough for rounding of float64 not to count beside its effect.
        rounded = (
            value.double() * (1 + 1e-6 * (2 * sign - 1))
            for value, sign in zip(single, signs, strict=True)
        )
        effect = torch.maximum(effect, (solve(*rounded) - wanted).abs() / 1e-6)
    bound = roundings * torch.finfo(torch.float32).eps * effect
    assert_near(solve(*single), wanted, bound, "m", "point")


@invariant("gradients")
def gradients_are_finite_differences(
    target: Target, scene: PosedScene, *, weights: Tensor | None = None
) -> None:
    """The gradient by pixels, cameras and weights is finite and that of finite differences."""
    weights = weights_for(target, scene, weights)
    inputs = [scene.views.proj, scene.pixels] + ([] if weights is None else [weights])

    def solve(*values: Tensor) -> Tensor:
        assert target.triangulate is not None
        return target.triangulate(values[0], values[1], values[2] if weights is not None else None)

    assert_gradients(solve, inputs, ("proj", "pixels", "weights"), "m")


@invariant("gradients", scenes="ties")
def gradients_are_finite_differences_at_ties(target: Target, scene: PosedScene) -> None:
    """The gradient is right where singular values are equal: at 90 degrees and on a ring."""
    # Unequal weights would break the tie.
    equal = torch.ones_like(scene.pixels[..., 0])
    gradients_are_finite_differences(target, scene, weights=equal)


@invariant("triangulate", scenes="named")
def points_are_finite(target: Target, scene: PosedScene, *, pixels: Tensor | None = None) -> None:
    """Points are finite, whatever the cameras and pixels."""
    if pixels is None:
        sizes = EXTREMES[:, :2].to(scene.pixels)
        pixels = torch.stack([sizes, sizes.flip(-1)] * 2)[: scene.views.num_views]
    for seen in (scene.pixels, pixels):
        equal = weights_for(target, scene, torch.ones_like(seen[..., 0]))
        assert_finite(points_of(target, scene._replace(pixels=seen), equal), "points")


@invariant("gradients", scenes="named")
def gradients_are_finite(target: Target, scene: PosedScene) -> None:
    """The gradient of the points that are finite is finite, whatever the cameras and pixels."""
    equal = weights_for(target, scene, torch.ones_like(scene.pixels[..., 0]))

    def loss(proj: Tensor, pixels: Tensor) -> Tensor:
        found = points_of(target, scene._replace(pixels=pixels), equal, proj=proj)
        return found[found.isfinite().all(dim=-1)].sum()

    for name, gradient in zip(
        ("proj", "pixels"), gradients(loss, [scene.views.proj, scene.pixels]), strict=True
    ):
        assert_finite(gradient, f"gradient by {name}")


def points_of(
    target: Target, scene: PosedScene, weights: Tensor | None, *, proj: Tensor | None = None
) -> Tensor:
    """What the target finds, ``(N, 3)``; other cameras than the scene's if ``proj`` is given."""
    assert target.triangulate is not None
    return target.triangulate(scene.views.proj if proj is None else proj, scene.pixels, weights)


def weights_for(target: Target, scene: PosedScene, weights: Tensor | None) -> Tensor | None:
    """``(V, N)``, unequal unless given; None for a target that does not heed them."""
    if not target.weighted:
        return None
    if weights is not None:
        return weights[: scene.views.num_views]
    views, points = scene.pixels.shape[:2]
    pattern = torch.arange(views)[:, None] + torch.arange(points)
    return 1 / (1 + pattern % 3).to(scene.pixels.dtype)
