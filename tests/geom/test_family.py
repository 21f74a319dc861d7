"""What the results of all solvers have in common: errors, covariance, parallax, limits."""

import inspect
import re
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from operations import Inputs, tensors_of
from solvers import inputs_of, sights
from torch import Tensor
from torch.testing import assert_close

import deltas_geom as geom
from deltas_geom import Status
from deltas_geom.testing import PosedScene
from deltas_geom.testing.fixed_scenes import seeded_scene

FOCAL = 300.0


def by_tracks(s: Inputs, **options: Any) -> Any:
    """As a list, view by view."""
    views, num = s["weights"].shape
    camera = torch.arange(views).repeat_interleave(num)
    point = torch.arange(num).repeat(views)
    return geom.triangulate_tracks(
        s["proj"], s["pixels"].reshape(-1, 2), camera, point, num, s["weights"].flatten(), **options
    )


def solved(name: str, s: Inputs, **options: Any) -> Any:
    """By the function of this name."""
    if name == "triangulate_tracks":
        return by_tracks(s, **options)
    if name == "triangulate_two_view":
        return geom.triangulate_two_view(s["proj"][:2], s["pixels"][:2], **options)
    seen = (s["poses"], s["rays"]) if name in OF_ANGLES else (s["proj"], s["pixels"])
    return getattr(geom, name)(*seen, s["weights"], **options)


OF_ANGLES = ["triangulate_rays", "triangulate_midpoint", "triangulate_inverse_depth_weighted"]
SOLVERS = ["triangulate", *OF_ANGLES, "triangulate_tracks", "triangulate_two_view"]
EACH = pytest.mark.parametrize("name", SOLVERS)
OF_RAYS = pytest.mark.parametrize("name", OF_ANGLES)


def weights_of(name: str, s: Inputs) -> Tensor:
    return torch.ones(2, 4).double() if name == "triangulate_two_view" else s["weights"]


def by_view(field: Tensor) -> Tensor:
    """Of a list of tracks as of views."""
    return field.reshape(-1, 4) if field.ndim == 1 else field


def angles(s: Inputs, points: Tensor) -> Tensor:
    """Between rays and the directions to points, rad."""
    to_points = geom.to_homogeneous(points) @ s["poses"][:, :3].mT
    across = torch.linalg.cross(s["rays"], to_points).norm(dim=-1)
    return torch.atan2(across, (s["rays"] * to_points).sum(dim=-1))


@EACH
@given(s=sights(4))
def test_the_residual_is_the_weighted_mean_of_the_errors(name: str, s: Inputs) -> None:
    found = solved(name, s)
    weights, errors = weights_of(name, s), by_view(found.errors)
    mean = ((weights * errors).square().sum(dim=0) / weights.square().sum(dim=0)).sqrt()
    assert_close(found.residual, mean, rtol=1e-9, atol=1e-12)


@OF_RAYS
@given(s=sights(4))
def test_errors_of_rays_are_angles(name: str, s: Inputs) -> None:
    found = solved(name, s)
    assert_close(found.errors, angles(s, found.points), rtol=0, atol=1e-12)  # rad


@given(s=sights(2))
def test_errors_of_two_views_are_distances_of_the_projections(s: Inputs) -> None:
    found = solved("triangulate_two_view", s)
    wanted = (found.pixels - s["pixels"]).norm(dim=-1)
    assert_close(found.errors, wanted, rtol=0, atol=1e-9)  # px


@given(s=sights(5), used=st.lists(st.booleans(), min_size=20, max_size=20))
def test_tracks_know_what_the_dense_function_knows(s: Inputs, used: list[bool]) -> None:
    s = s | {"weights": s["weights"] * torch.tensor(used).reshape(5, 4)}
    found, wanted = by_tracks(s, covariance=True), solved("triangulate", s, covariance=True)
    assert_close(by_view(found.errors), wanted.errors, rtol=0, atol=1e-9)  # px
    assert torch.equal(by_view(found.used), s["weights"] > 0)
    size = float(wanted.covariance.abs().max())
    assert_close(found.covariance, wanted.covariance, rtol=0, atol=1e-9 * (1e-9 + size))
    few = (s["weights"] > 0).sum(dim=0) <= 3
    assert_close(found.parallax[few], wanted.parallax[few], rtol=0, atol=1e-9)  # rad
    assert (found.parallax <= wanted.parallax + 1e-9).all()
    assert (found.parallax >= 0.5 * wanted.parallax - 1e-9).all()


def test_the_parallax_of_long_tracks_is_nearly_the_largest() -> None:
    generator = torch.Generator().manual_seed(0)
    centers = torch.randn(20, 3, generator=generator, dtype=torch.float64)
    points = 4 * torch.randn(500, 3, generator=generator, dtype=torch.float64)
    points[:, 2] += 20
    poses = torch.eye(4).double().repeat(20, 1, 1)
    poses[:, :3, 3] = -centers
    pixels = geom.project(geom.PosedViews(torch.eye(3).double().expand(20, 3, 3), poses), points)
    camera, point = torch.arange(20).repeat_interleave(500), torch.arange(500).repeat(20)
    ours = geom.triangulate_tracks(poses[:, :3], pixels.pixels.reshape(-1, 2), camera, point, 500)
    share = ours.parallax / geom.triangulate(poses[:, :3], pixels.pixels).parallax
    assert share.max() < 1 + 1e-9 and share.min() > 0.8 and share.mean() > 0.98
    assert (share > 1 - 1e-9).double().mean() > 0.6


@given(s=sights(2))
def test_the_covariance_of_two_views_is_that_of_their_points(s: Inputs) -> None:
    found = solved("triangulate_two_view", s, covariance=True)
    wanted = geom.point_covariance(s["proj"], found.points, torch.ones(2, 4).double())
    assert_close(found.covariance, wanted, rtol=1e-9, atol=0)


@OF_RAYS
@given(s=sights(4))
def test_the_covariance_of_rays_is_what_their_angles_allow(name: str, s: Inputs) -> None:
    found = solved(name, s, covariance=True)
    # Half the second derivative of the squares of the angles, at rays without error.
    exact = geom.to_homogeneous(found.points) @ s["poses"][:, :3].mT
    for n in range(4):

        def cost(point: Tensor, n: int = n) -> Tensor:
            sines = torch.linalg.cross(
                torch.nn.functional.normalize(exact[:, n], dim=-1),
                torch.nn.functional.normalize(
                    geom.to_homogeneous(point) @ s["poses"][:, :3].mT, dim=-1
                ),
            )
            return (s["weights"][:, n, None] * sines).square().sum() / 2

        information = torch.autograd.functional.hessian(cost, found.points[n])
        wanted = torch.linalg.inv(information)
        size = float(wanted.abs().max())
        assert_close(found.covariance[n], wanted, rtol=0, atol=1e-6 * size)  # m^2


def test_the_covariance_of_rays_is_what_monte_carlo_finds() -> None:
    generator = torch.Generator().manual_seed(0)
    poses = torch.eye(4).double().repeat(3, 1, 1)
    poses[1, 0, 3], poses[2, 1, 3] = -1.0, -0.7
    point = torch.tensor([0.3, 0.2, 3.0]).double()
    weights = torch.tensor([300.0, 500, 400]).double()[:, None].expand(3, 20000)
    exact = (point + poses[:, :3, 3])[:, None].expand(3, 20000, 3)
    off = torch.randn(exact.shape, generator=generator, dtype=torch.float64) / weights[..., None]
    rays = exact / exact.norm(dim=-1, keepdim=True) + off  # along the ray it has no effect
    found = geom.triangulate_rays(poses, rays, weights)
    wanted = geom.triangulate_rays(poses, exact[:, :1], weights[:, :1], covariance=True)
    assert wanted.covariance is not None
    spread = torch.cov(found.points.mT)
    assert_close(spread, wanted.covariance[0], rtol=0.05, atol=0.02 * float(spread.max()))


@EACH
@given(s=sights(4), share=st.floats(0.3, 1.5))
def test_max_residual_refuses_points_that_the_views_disagree_about(
    name: str, s: Inputs, share: float
) -> None:
    free = solved(name, s, covariance=True)
    limit = max(share * float(free.residual.median()), 1e-12)
    found = solved(name, s, covariance=True, max_residual=limit)
    large = free.residual > limit
    assert torch.equal(found.status == Status.RESIDUAL_TOO_LARGE, large)
    assert torch.equal(found.errors, free.errors)
    assert_refused(found, free, large)
    again = free.within_residual(limit)
    assert all(
        torch.equal(*pair) for pair in zip(tensors_of(again), tensors_of(found), strict=True)
    )


@EACH
@given(s=sights(4), far=st.floats(1.9, 6.0))
def test_within_depth_refuses_points_that_some_view_has_outside(
    name: str, s: Inputs, far: float
) -> None:
    free = solved(name, s, covariance=True)
    every = isinstance(free, (geom.TriangulatedTracks, geom.TwoViewTriangulation))
    found = free.within_depth((0.5, far))
    depth = by_view(free.depth)
    outside = (depth > far).any(dim=0) if every else depth[0] > far
    assert torch.equal(found.status == Status.OUT_OF_RANGE, outside)
    assert_refused(found, free, outside)


def assert_refused(found: Any, free: Any, outside: Tensor) -> None:
    """What is outside is 0, and the rest as it was."""
    assert type(found) is type(free) and torch.equal(found.valid, free.valid & ~outside)
    pairs = (("points", -2), ("depth", -1), ("residual", -1), ("parallax", -1), ("covariance", -3))
    for name, dim in pairs:
        ours, theirs = getattr(found, name), getattr(free, name)
        if name == "depth":
            ours, theirs = by_view(ours), by_view(theirs)
        inside = (~outside).nonzero()[:, 0]
        assert torch.equal(ours.index_select(dim, inside), theirs.index_select(dim, inside)), name
        assert (ours.index_select(dim, outside.nonzero()[:, 0]) == 0).all(), name


@EACH
def test_parallax_says_that_it_has_no_gradient(name: str) -> None:
    s = inputs_of(seeded_scene(0, num_views=4, num_points=4))
    s |= {key: s[key].clone().requires_grad_() for key in ("pixels", "rays")}
    found = solved(name, s)
    assert found.points.requires_grad and not found.parallax.requires_grad


@EACH
def test_a_refused_point_has_no_gradient_and_the_others_keep_theirs(name: str) -> None:
    generator = torch.Generator().manual_seed(0)
    poses = torch.eye(4).double().repeat(4, 1, 1)
    poses[:, 0, 3] = -0.3 * torch.arange(4)
    K = torch.tensor([[FOCAL, 0, 160], [0, FOCAL, 120], [0, 0, 1]]).double().expand(4, 3, 3)
    points = torch.tensor([[0.0, 0, 3], [0.2, 0.1, 3], [0.4, -0.1, 4], [0, 0.2, 5]]).double()
    pixels = geom.project(geom.PosedViews(K, poses), points).pixels
    pixels = pixels + 0.1 * torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
    pixels[0, 1, 1] += 30
    pixels.requires_grad_()
    s = inputs_of(PosedScene(geom.PosedViews(K, poses), points, pixels))
    of_rays = name in OF_ANGLES
    found = solved(name, s, max_residual=4 / FOCAL if of_rays else 4.0)
    near = solved(name, s).within_depth((0.5, 3.6))
    assert near.valid[[0, 2, 3]].tolist() == [True, False, False]
    reached = near.points.sum() + near.depth.sum()
    (gradient,) = torch.autograd.grad(reached, pixels, retain_graph=True)
    assert gradient.isfinite().all() and (gradient[:, 2:] == 0).all()
    assert (gradient[:2, 0] != 0).any()
    assert found.valid.tolist() == [True, False, True, True]
    assert by_view(found.errors)[:2, 1].max() > (4 / FOCAL if of_rays else 4.0)
    total = found.points.sum() + found.depth.sum() + found.residual.sum()
    if name == "triangulate_two_view":
        total = total + found.pixels.sum()
    (gradient,) = torch.autograd.grad(total, pixels)
    assert gradient.isfinite().all() and (gradient[:, 1] == 0).all()
    assert (gradient[:2, [0, 2, 3]] != 0).any(dim=-1).all()


@EACH
def test_a_limit_is_positive(name: str) -> None:
    s = inputs_of(seeded_scene(0, num_views=4, num_points=4))
    with pytest.raises(ValueError, match="max_residual must be positive, got 0"):
        solved(name, s, max_residual=0.0)


def test_every_function_of_views_says_how_points_before_views_are_noticed() -> None:
    public = {name: getattr(geom, name) for name in geom.__all__ if name != "diagnose"}
    of_views = {
        name: function.__doc__
        for name, function in public.items()
        if inspect.isfunction(function)
        and {"pixels", "rays", "weights", "used"} & {*inspect.signature(function).parameters}
        and ("V, N" in function.__doc__ or "triangulate" in name)
    }
    # A list has indices to mix up; who only refers to another function has nothing to add.
    says = re.compile(r"\((\*B, )?N, [V2]|[Ii]ndices|returns and raises are those of")
    assert {name for name, text in of_views.items() if not says.search(text)} == set()
    assert len(of_views) > 12


@EACH
def test_points_before_views_have_large_residuals(name: str) -> None:
    if name == "triangulate_tracks":  # a list has no axes to swap
        return
    num = 2 if name == "triangulate_two_view" else 4
    generator = torch.Generator().manual_seed(1)
    poses = torch.eye(4).double().repeat(num, 1, 1)
    poses[:, :2, 3] = 0.3 * torch.randn(num, 2, generator=generator, dtype=torch.float64)
    K = torch.tensor([[FOCAL, 0, 160], [0, FOCAL, 120], [0, 0, 1]]).double().expand(num, 3, 3)
    points = torch.randn(num, 3, generator=generator, dtype=torch.float64)
    points[:, 2] += 4
    pixels = geom.project(geom.PosedViews(K, poses), points).pixels
    wrong = pixels.transpose(0, 1).contiguous()
    limit = 4.0 if name in ("triangulate", "triangulate_two_view") else 4 / FOCAL
    for seen, fits in ((pixels, True), (wrong, False)):
        s = inputs_of(PosedScene(geom.PosedViews(K, poses), points, seen))
        found = solved(name, s, max_residual=limit)
        assert found.valid.all() if fits else not found.valid.any()
