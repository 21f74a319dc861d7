"""Triangulation.within_depth: points outside a depth range are no points."""

import math

import pytest
import torch
from hypothesis import given
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import (
    PosedViews,
    ShapeError,
    project,
    triangulate,
    triangulate_robust,
)
from deltas_geom.testing import PosedScene
from deltas_geom.testing.strategies import posed_scenes


def stereo(depths: Tensor) -> tuple[PosedViews, Tensor]:
    """Two cameras 0.2 m apart, and where they see points of these depths in front of the first."""
    K = torch.tensor([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]]).expand(2, 3, 3)
    pose = torch.eye(4).repeat(2, 1, 1)
    pose[1, 0, 3] = -0.2
    views = PosedViews(K, pose)
    points = torch.stack([torch.zeros_like(depths), torch.zeros_like(depths), depths], dim=-1)
    return views, project(views, points).pixels


@given(scene=posed_scenes())
def test_the_range_is_that_of_the_view_and_refuses_once(scene: PosedScene) -> None:
    found = triangulate(scene.views.proj, scene.pixels, covariance=True)
    far = float(found.depth[:, 0].mean())  # which one of the views has the first point within
    for view in (0, -1):
        within = found.within_depth((0.1, far), view=view)
        assert torch.equal(within.valid, found.valid & (found.depth[view] <= far))
        again = within.within_depth((0.1, far), view=view)
        assert all(torch.equal(*pair) for pair in zip(again, within, strict=True))


def test_both_ends_are_included_and_far_may_be_infinite() -> None:
    views, pixels = stereo(torch.tensor([0.5, 2.0, 60.0]))
    found = triangulate(views.proj, pixels)
    near, _, far = found.depth[0].tolist()
    assert found.within_depth((near, far)).valid.all()
    assert found.within_depth((near, 50.0)).valid.tolist() == [True, True, False]
    assert found.within_depth((1.0, math.inf)).valid.tolist() == [False, True, True]


def test_any_batch_dims_and_no_covariance() -> None:
    views, pixels = stereo(torch.tensor([2.0, 60.0]))
    batched = pixels.expand(2, 3, *pixels.shape)
    found = triangulate(views.proj, batched).within_depth((0.5, 20.0))
    assert found.covariance is None
    assert_close(found.valid, torch.tensor([True, False]).expand(2, 3, 2))


def test_what_a_view_did_not_see_need_not_be_in_its_range() -> None:
    # The third camera looks the other way.
    views, pixels = stereo(torch.tensor([2.0, 9.0]))
    away = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    proj = torch.cat([PosedViews(views.K[:1], away[None]).proj, views.proj])
    pixels = torch.cat([torch.full((1, 2, 2), torch.nan), pixels])
    used = torch.tensor([False, True, True])[:, None].expand(3, 2)
    found = triangulate(proj, pixels, mask=used)
    assert found.valid.all()
    assert not found.within_depth((0.5, 5.0)).valid.any()
    within = found.within_depth((0.5, 5.0), used=used)
    assert within.valid.tolist() == [True, False]
    assert torch.equal(within.points[0], found.points[0])
    robust = triangulate_robust(proj, pixels).within_depth((0.5, 5.0))
    assert robust.valid.tolist() == [True, False]
    assert robust.inliers.tolist() == [[False, False], [True, False], [True, False]]
    assert (robust.points[1] == 0).all() and robust.covariance is None


def test_of_used_views_all_must_have_the_point_in_range() -> None:
    # Cameras one behind the other: 2 m from one is 3 m from the other.
    views, _ = stereo(torch.tensor([2.0]))
    pose = views.cam_from_world.clone()
    pose[1, :3, 3] = torch.tensor([-0.2, 0.0, 1.0])
    views = views._replace(cam_from_world=pose)
    pixels = project(views, torch.tensor([[0.1, 0.0, 2.0]])).pixels
    found = triangulate(views.proj, pixels)
    both = torch.ones(2, 1, dtype=torch.bool)
    assert found.within_depth((1.5, 2.5)).valid.all()
    assert not found.within_depth((1.5, 2.5), used=both).valid.any()
    assert found.within_depth((1.5, 3.5), used=both).valid.all()
    with pytest.raises(ShapeError, match="used has V = 1 but depth has V = 2"):
        found.within_depth((1.5, 3.5), used=both[:1])
    with pytest.raises(TypeError, match="used must be bool"):
        found.within_depth((1.5, 3.5), used=both.float())


@pytest.mark.parametrize("depth_range", [(0.0, 1.0), (2.0, 1.0), (-1.0, 1.0), (1.0, math.nan)])
def test_a_range_that_makes_no_sense_is_refused(depth_range: tuple[float, float]) -> None:
    views, pixels = stereo(torch.tensor([2.0]))
    with pytest.raises(ValueError, match="0 < near < far"):
        triangulate(views.proj, pixels).within_depth(depth_range)
