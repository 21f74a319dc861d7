"""Invariants of fundamental matrices. They have no scale: their lines are compared, in pixels."""

import torch
from torch import Tensor

from deltas_geom.cameras.projection import project
from deltas_geom.cameras.views import PosedViews
from deltas_geom.epipolar.fundamental import epipolar_distance, epipolar_lines
from deltas_geom.testing.agreement import (
    PIXEL_TOLERANCE,
    assert_finite,
    assert_near,
    assert_same_lines,
)
from deltas_geom.testing.changes import ELSEWHERE, World, cut, transformed
from deltas_geom.testing.registry import invariant
from deltas_geom.testing.scenes import PosedScene
from deltas_geom.testing.target import Target


@invariant("fundamental")
def a_match_lies_on_its_epipolar_line(
    target: Target, scene: PosedScene, *, tolerance: float = PIXEL_TOLERANCE
) -> None:
    """x1^T F x0 = 0 for the pixels x0, x1 of a point, and there is a line."""
    first, second = project(scene.views, scene.points).pixels[:2]
    found = _fundamental(target, scene.views)
    offset = epipolar_distance(found, first, second)
    assert_near(offset, torch.zeros_like(offset), tolerance, "px")
    length = epipolar_lines(found, first)[:, :2].norm(dim=-1)
    assert_near(length, torch.ones_like(length), 1e-6, "(length of a line's normal)")


@invariant("fundamental")
def the_fundamental_matrix_back_is_the_transpose(
    target: Target, scene: PosedScene, *, tolerance: float = PIXEL_TOLERANCE
) -> None:
    """F from view 1 to view 0 is the transpose of F from view 0 to view 1."""
    back = _fundamental(target, scene.views.select([1, 0]))
    assert_same_lines(back, _fundamental(target, scene.views).mT, scene.pixels[1], tolerance)


@invariant("fundamental")
def the_fundamental_matrix_does_not_know_the_worlds_frame(
    target: Target,
    scene: PosedScene,
    *,
    world: World = ELSEWHERE,
    tolerance: float = PIXEL_TOLERANCE,
) -> None:
    """F stays, up to scale, when the cameras are moved, turned and scaled together."""
    moved = _fundamental(target, world.views(scene.views))
    assert_same_lines(moved, _fundamental(target, scene.views), scene.pixels[0], tolerance)


@invariant("fundamental")
def the_fundamental_matrix_follows_a_crop_and_a_resize(
    target: Target, scene: PosedScene, *, tolerance: float = PIXEL_TOLERANCE
) -> None:
    """F of cropped and resized images is A1^-T F A0^-1, A the change of each view's pixels."""
    change = cut(scene.views, new_size=(240, 160))
    back = torch.linalg.inv(change)
    wanted = back[1].mT @ _fundamental(target, scene.views) @ back[0]
    found = _fundamental(target, scene.views._replace(K=change @ scene.views.K))
    assert_same_lines(found, wanted, transformed(change, scene.pixels)[0], tolerance)


@invariant("fundamental", scenes="named")
def the_fundamental_matrix_is_finite(target: Target, scene: PosedScene) -> None:
    """F is finite wherever the cameras stand."""
    assert_finite(_fundamental(target, scene.views), "F")


def _fundamental(target: Target, views: PosedViews) -> Tensor:
    assert target.fundamental is not None
    pair = views.select(slice(2))
    return target.fundamental(pair.K, pair.cam_from_world)
