"""Which views are wrong about a point: by construction, and where nothing can tell."""

from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from operations import Inputs
from solvers import sights
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import (
    PosedViews,
    RobustTriangulation,
    Status,
    triangulate,
    triangulate_robust,
)
from deltas_geom.testing import PosedScene, ring, scene_from
from deltas_geom.testing.fixed_scenes import seeded_scene
from deltas_geom.triangulation import robust
from deltas_geom.triangulation.pairs import pairs_of


def seen(inputs: Inputs) -> tuple[Tensor, Tensor, Tensor]:
    """Cameras, pixels and weights; noise is within the default threshold of 4 px."""
    return inputs["proj"], inputs["pixels"], inputs["weights"]


def assert_same(found: RobustTriangulation, wanted: Any, *, atol: float = 1e-9) -> None:
    """All that both tell of the points, m and px."""
    assert torch.equal(found.status, wanted.status) and torch.equal(found.valid, wanted.valid)
    for name in ("points", "residual", "parallax"):
        assert_close(getattr(found, name), getattr(wanted, name), rtol=0, atol=atol)


def test_wrong_arguments_are_named() -> None:
    proj, pixels = torch.zeros(2, 3, 4), torch.zeros(2, 5, 2)
    with pytest.raises(ValueError, match="threshold must be positive, got 0"):
        triangulate_robust(proj, pixels, threshold=0)
    with pytest.raises(ValueError, match="min_inliers must be 2 or more, got 1"):
        triangulate_robust(proj, pixels, min_inliers=1)
    with pytest.raises(ValueError, match="max_pairs must be 1 or more, got 0"):
        triangulate_robust(proj, pixels, max_pairs=0)


@pytest.mark.parametrize("num_views", [2, 3, 5])
@given(data=st.data())
def test_without_outliers_it_is_triangulation(num_views: int, data: st.DataObject) -> None:
    inputs = seen(data.draw(sights(num_views)))
    found = triangulate_robust(*inputs, covariance=True)
    wanted = triangulate(*inputs, covariance=True)
    assert found.inliers.all()
    for ours, plain in zip(found, wanted, strict=False):
        assert torch.equal(ours, plain)


@pytest.mark.parametrize("num_views", [4, 5, 8])
@given(data=st.data())
def test_one_gross_outlier_is_found(num_views: int, data: st.DataObject) -> None:
    drawn = data.draw(sights(num_views, outliers=True))
    found = triangulate_robust(*seen(drawn))
    assert torch.equal(found.inliers, ~drawn["outliers"])
    assert_same(found, triangulate(*seen(drawn), ~drawn["outliers"]), atol=0)


@given(
    drawn=sights(5, outliers=True),
    view=st.integers(0, 4),
    value=st.sampled_from([torch.nan, torch.inf]),
)
def test_a_view_that_is_not_finite_is_an_outlier(drawn: Inputs, view: int, value: float) -> None:
    there = (torch.arange(5) != view)[:, None].expand(5, 4)
    wanted = triangulate_robust(*seen(drawn), there)
    for spoilt in range(3):
        inputs = [tensor.clone() for tensor in seen(drawn)]
        inputs[spoilt][view] = value
        found = triangulate_robust(*inputs)
        assert torch.equal(found.inliers, wanted.inliers)
        assert_same(found, wanted)


def test_what_fails_says_why() -> None:
    scene = ring()
    pixels = scene.pixels.repeat(1, 7, 1)
    mask = torch.ones(4, 7, dtype=torch.bool)
    pixels[1:, 1:4] += torch.tensor([[0, 90], [0, -90], [50, 200]])[:, None]  # px: none agree
    mask[1:, 2] = False  # a view alone
    pixels[1, 3] = torch.nan  # the others do not agree either
    mask[2:, 4] = False
    pixels[1, 4, 1] += 60  # two that disagree
    mask[3, 5] = False
    pixels[0, 5] = torch.inf
    pixels[0, 6] = torch.nan
    mask[2:, 6] = False  # without it there is one view
    result = triangulate_robust(scene.views.proj, pixels, mask=mask)
    few, unknown = Status.TOO_FEW_VIEWS, Status.NOT_FINITE_INPUT
    assert result.status.tolist() == [Status.OK, few, few, few, few, Status.OK, unknown]
    assert torch.equal(result.valid, result.status == Status.OK)
    assert torch.equal(result.inliers.any(dim=0), result.valid)
    for value in (result.points.mT, result.depth, result.residual, result.parallax):
        assert (value[..., ~result.valid] == 0).all()


def test_a_third_view_must_confirm_where_asked(dtype: torch.dtype) -> None:
    scene = ring(dtype=dtype)
    pixels = scene.pixels.clone()
    pixels[2:] += torch.tensor([[[0, 90]], [[0, -90]]])  # px
    two = triangulate_robust(scene.views.proj, pixels)
    assert two.inliers[:, 0].tolist() == [True, True, False, False]
    three = triangulate_robust(scene.views.proj, pixels, min_inliers=3)
    assert three.status.item() == Status.TOO_FEW_VIEWS and not three.inliers.any()


def test_a_pair_without_parallax_has_no_say() -> None:
    # Views 0 and 1 share a place and a wrong match: they agree at every depth, and on none.
    scene = ring()
    proj, pixels = scene.views.proj[[0, 0, 1, 2, 3]], scene.pixels[[0, 0, 1, 2, 3]]
    pixels[:2] += 40  # px
    found = triangulate_robust(proj, pixels)
    assert found.inliers[:, 0].tolist() == [False, False, True, True, True]


def test_a_view_behind_which_a_point_lies_does_not_agree() -> None:
    scene, _ = in_a_row(4, 5)
    pose = scene.views.cam_from_world.clone()
    # The last camera turns its back; its pixels are those of the rays through its centre.
    pose[3] = torch.diag(torch.tensor([-1.0, 1, -1, 1])).double() @ pose[3]
    proj, pixels = PosedViews(scene.views.K, pose).proj, scene.pixels.clone()
    seen = scene.points @ proj[3, :, :3].mT + proj[3, :, 3]
    pixels[3] = seen[:, :2] / seen[:, 2:]
    found = triangulate_robust(proj, pixels)
    assert found.valid.all() and found.inliers.sum(dim=1).tolist() == [5, 5, 5, 0]


def test_an_unused_view_agrees_with_nothing() -> None:
    views = ring().views.crop(left=320, top=240)  # the point is seen at (0, 0)
    mask = torch.tensor([True, True, False, True])[:, None]
    pixels = torch.zeros(4, 1, 2).double()
    found = triangulate_robust(views.proj, pixels, mask=mask)
    assert torch.equal(found.inliers, mask)
    # A weight that does not count in triangulation does not count here.
    weights = torch.where(mask, 1.0, 1e-9).double()
    assert torch.equal(triangulate_robust(views.proj, pixels, weights).inliers, mask)


@pytest.mark.parametrize("size", [1e60, 1e75, 1e100, 1e300, 1.5e308])
def test_a_wild_view_spoils_no_other(size: float) -> None:
    scene = ring()
    wanted = [True, True, True, False]
    for wild in range(3):
        proj, pixels = scene.views.proj.clone(), scene.pixels.clone()
        if wild == 0:
            pixels[3] = size
        elif wild == 1:
            proj[3] = size * torch.linspace(-1, 1, 12).reshape(3, 4)
        else:
            proj[3, :, 3] = size * torch.tensor([1.0, 0.5, 1])
        inputs = proj.requires_grad_(), pixels.requires_grad_()
        found = triangulate_robust(*inputs)
        assert found.inliers[:, 0].tolist() == wanted
        assert all(value is None or value.isfinite().all() for value in found)
        gradients = torch.autograd.grad(found.points.sum() + found.residual.sum(), inputs)
        assert all(gradient.isfinite().all() for gradient in gradients)


@given(drawn=sights(2), off=st.floats(10, 30))
def test_a_threshold_is_a_distance_in_pixels(drawn: Inputs, off: float) -> None:
    drawn["pixels"][1, :, 1] += off
    distance = triangulate(drawn["proj"], drawn["pixels"]).errors.amax(dim=0)
    assert (distance > 2).all()  # px: epipolar lines within 0.7 rad of the rows
    for point in range(4):
        some = drawn["pixels"][:, point : point + 1]
        for factor in (0.5, 1.001):
            found = triangulate_robust(
                drawn["proj"], some, threshold=factor * float(distance[point])
            )
            assert found.valid.item() == (factor > 1)


@pytest.mark.parametrize("num_views", [3, 4])
def test_inliers_are_within_the_threshold_of_the_point_returned(num_views: int) -> None:
    # Noise as large as that, and weights that draw the point of those who agree to one of them.
    scene = seeded_scene(3, num_views=num_views, num_points=300, noise=4.0)
    generator = torch.Generator().manual_seed(0)
    weights = 10 ** (-3 * torch.rand(num_views, 300, generator=generator).double())
    found = triangulate_robust(scene.views.proj, scene.pixels, weights, threshold=4.0)
    assert (found.errors[found.inliers] < 4).all()
    assert torch.equal(found.valid, found.inliers.any(dim=0))
    assert 0.8 < found.valid.double().mean() < 1  # others are refused


def test_fewer_pairs_than_views_begin_all_over_the_circle() -> None:
    first, second, exist = pairs_of(torch.ones(100, 1, dtype=torch.bool), 10)
    assert exist.all() and first.flatten().diff().tolist() == [10] * 9
    assert torch.cat([first, second]).unique().numel() == 20  # each view as often


def test_a_heavy_view_is_rejected_last() -> None:
    scene = ring()
    pixels = scene.pixels.clone()
    pixels[2:] = scene_from(scene.views, scene.points + 0.3).pixels[2:]  # two against two
    for heavy in ([0, 1], [2, 3]):
        weights = torch.ones(4, 1).double()
        weights[heavy] = 1.5
        found = triangulate_robust(scene.views.proj, pixels, weights)
        assert found.inliers[:, 0].nonzero().flatten().tolist() == heavy


def in_a_row(num_views: int, num_points: int) -> tuple[PosedScene, Tensor]:
    """A row of cameras 2 m long, and pixels of which no two agree in any two of its views."""
    pose = torch.eye(4).double().repeat(num_views, 1, 1)
    pose[:, 0, 3] = -torch.linspace(-1, 1, num_views).double()
    views = PosedViews(ring().views.K[:1].expand(num_views, 3, 3), pose)
    points = torch.linspace(-0.5, 0.5, num_points).double()[:, None] * torch.tensor([1, 0.5, 0.5])
    scene = scene_from(views, points + torch.tensor([0, 0, 4]))
    wrong = scene.pixels.clone()
    wrong[..., 1] += 40 + 20 * torch.arange(num_views)[:, None]
    return scene, wrong


@pytest.mark.parametrize(
    ("num_views", "budget"), [(4, None), (5, None), (10, None), (11, None), (5, 1)]
)
def test_of_eleven_views_any_two_that_agree_are_found(
    num_views: int, budget: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    if budget is not None:  # one candidate of one point at a time
        monkeypatch.setattr(robust, "_BUDGET", budget)
    pairs = torch.combinations(torch.arange(num_views))
    scene, wrong = in_a_row(num_views, len(pairs))
    agree = (torch.arange(num_views)[:, None, None] == pairs).any(dim=-1)
    pixels = torch.where(agree[..., None], scene.pixels, wrong)
    found = triangulate_robust(scene.views.proj, pixels)
    assert torch.equal(found.inliers, agree)
    assert_close(found.points, scene.points, rtol=0, atol=1e-9)  # m


@pytest.mark.parametrize("num_views", [12, 13, 30, 90])
def test_many_views_are_judged_by_some_pairs(num_views: int) -> None:
    scene, wrong = in_a_row(num_views, 60)
    order = torch.arange(num_views)[:, None] + torch.arange(60)
    # Two of five are wrong, and pairs must be of views that see the point: every other one.
    agree, mask = order % 5 < 3, order * 3 // 2 % 2 == 0
    pixels = torch.where(agree[..., None], scene.pixels, wrong)
    found = triangulate_robust(scene.views.proj, pixels, mask=mask)
    assert torch.equal(found.inliers, mask & agree)
    assert_close(found.points, scene.points, rtol=0, atol=1e-9)  # m


@given(drawn=sights(5, outliers=True))
def test_gradients_are_those_of_the_inliers(drawn: Inputs) -> None:
    outliers = drawn["outliers"]
    drawn["pixels"][:, 3] = 1e4 * torch.arange(10).reshape(5, 2)  # none agree
    inputs = [value.clone().requires_grad_() for value in seen(drawn)]
    found = triangulate_robust(*inputs)
    wanted = triangulate(*inputs, found.inliers)
    assert found.valid.tolist() == [True, True, True, False]
    ours = torch.autograd.grad(found.points.sum() + found.residual.sum(), inputs)
    plain = torch.autograd.grad(wanted.points.sum() + wanted.residual.sum(), inputs)
    assert all(torch.equal(a, b) and a.isfinite().all() for a, b in zip(ours, plain, strict=True))
    for gradient in ours[1:]:
        assert (gradient[outliers] == 0).all() and (gradient[:, 3] == 0).all()
        assert (gradient[:, 0] != 0).any()
