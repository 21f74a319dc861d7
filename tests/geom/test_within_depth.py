"""Triangulation.within_depth: points outside a depth range are no points."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import PosedViews, Status, project, triangulate
from deltas_geom.testing import PosedScene
from deltas_geom.testing.strategies import posed_scenes

RANGES = st.tuples(st.floats(0.3, 6.0), st.floats(0.01, 20.0)).map(lambda r: (r[0], r[0] + r[1]))


def stereo(depths: Tensor) -> tuple[PosedViews, Tensor]:
    """Two cameras 0.2 m apart, and where they see points of these depths in front of the first."""
    K = torch.tensor([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]]).expand(2, 3, 3)
    pose = torch.eye(4).repeat(2, 1, 1)
    pose[1, 0, 3] = -0.2
    views = PosedViews(K, pose)
    points = torch.stack([torch.zeros_like(depths), torch.zeros_like(depths), depths], dim=-1)
    return views, project(views, points).pixels


@given(scene=posed_scenes(), depth_range=RANGES, last=st.booleans())
def test_inside_nothing_changes_and_outside_nothing_is_left(
    scene: PosedScene, depth_range: tuple[float, float], last: bool
) -> None:
    view = -1 if last else 0
    found = triangulate(scene.views.proj, scene.pixels, covariance=True)
    within = found.within_depth(depth_range, view=view)
    depth = found.depth[..., view, :]
    outside = found.valid & ((depth < depth_range[0]) | (depth > depth_range[1]))
    assert torch.equal(within.valid, found.valid & ~outside)
    assert torch.equal(within.status == Status.OUT_OF_RANGE.value, outside)
    assert torch.equal(within.status[~outside], found.status[~outside])
    assert within.status.dtype == found.status.dtype
    for now, before in (
        (within.points, found.points),
        (within.depth.mT, found.depth.mT),
        (within.residual, found.residual),
        (within.parallax, found.parallax),
        (within.covariance, found.covariance),
    ):
        assert now is not None and before is not None and now.dtype == before.dtype
        assert torch.equal(now[~outside], before[~outside])
        assert (now[outside] == 0).all()
    again = within.within_depth(depth_range, view=view)
    assert all(torch.equal(*pair) for pair in zip(again, within, strict=True))  # type: ignore[arg-type]


def test_both_ends_are_included_and_far_may_be_infinite() -> None:
    views, pixels = stereo(torch.tensor([0.5, 2.0, 60.0]))
    found = triangulate(views.proj, pixels)
    near, _, far = found.depth[0].tolist()
    assert found.within_depth((near, far)).valid.all()
    assert found.within_depth((near, 50.0)).valid.tolist() == [True, True, False]
    assert found.within_depth((1.0, math.inf)).valid.tolist() == [False, True, True]


def test_a_point_out_of_range_has_no_gradient() -> None:
    views, pixels = stereo(torch.tensor([2.0, 60.0]))
    pixels.requires_grad_()
    found = triangulate(views.proj, pixels, covariance=True).within_depth((0.5, 20.0))
    assert found.covariance is not None
    total = found.points.sum() + found.depth.sum() + found.covariance.sum()
    (gradient,) = torch.autograd.grad(total, pixels)
    assert gradient.isfinite().all()
    assert (gradient[:, 0] != 0).any() and (gradient[:, 1] == 0).all()


def test_any_batch_dims_and_no_covariance() -> None:
    views, pixels = stereo(torch.tensor([2.0, 60.0]))
    batched = pixels.expand(2, 3, *pixels.shape)
    found = triangulate(views.proj, batched).within_depth((0.5, 20.0))
    assert found.covariance is None
    assert_close(found.valid, torch.tensor([True, False]).expand(2, 3, 2))


@pytest.mark.parametrize("depth_range", [(0.0, 1.0), (2.0, 1.0), (-1.0, 1.0), (1.0, math.nan)])
def test_a_range_that_makes_no_sense_is_refused(depth_range: tuple[float, float]) -> None:
    views, pixels = stereo(torch.tensor([2.0]))
    with pytest.raises(ValueError, match="0 < near < far"):
        triangulate(views.proj, pixels).within_depth(depth_range)
