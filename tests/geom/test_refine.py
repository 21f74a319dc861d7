"""Gauss-Newton refinement of points, by its invariants."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from refinement_cases import LOSSES, SCALE, near_misses, robust_cost, scene_at
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import ShapeError, project, refine_points, reprojection_residual
from deltas_geom.testing import PosedScene, forward_motion, right_angle
from deltas_geom.testing.fixed_scenes import seeded_scene
from deltas_geom.testing.strategies import posed_scenes, vectors
from deltas_geom.triangulation.refine import Loss


def test_wrong_arguments_are_named() -> None:
    proj, pixels, points = torch.zeros(2, 3, 4), torch.zeros(2, 5, 2), torch.zeros(5, 3)
    with pytest.raises(ShapeError, match="points has N = 4 but pixels has N = 5"):
        refine_points(proj, pixels, points[:4])
    with pytest.raises(ValueError, match="or 'cauchy', got 'l1'"):
        refine_points(proj, pixels, points, loss="l1")
    with pytest.raises(ValueError, match="or 'implicit', got 'none'"):
        refine_points(proj, pixels, points, gradient="none")
    with pytest.raises(ValueError, match="steps must be 0 or more, got -1"):
        refine_points(proj, pixels, points, steps=-1)
    with pytest.raises(ValueError, match="scale must be positive, got 0"):
        refine_points(proj, pixels, points, scale=0)


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_where_nothing_or_everything_is_far_answers_are_numbers(loss: Loss) -> None:
    scene = seeded_scene(3, num_views=4, noise=1.0)
    pixels, start = scene.pixels.clone().requires_grad_(), scene.points + 0.05
    wanted = refine_points(scene.views.proj, pixels, start, steps=3)
    for scale in (torch.inf, 1e200, 1e-200):
        found = refine_points(scene.views.proj, pixels, start, steps=3, loss=loss, scale=scale)
        assert found.valid.all()
        assert torch.autograd.grad(found.points.sum(), pixels)[0].isfinite().all()
        if scale > 1:
            assert_close(found.points, wanted.points, rtol=0, atol=1e-9)  # m


@given(drawn=near_misses(), steps=st.integers(0, 4), loss=st.sampled_from(LOSSES))
def test_the_cost_never_grows(
    drawn: tuple[PosedScene, Tensor, Tensor], steps: int, loss: Loss
) -> None:
    scene, weights, start = drawn
    proj, pixels = scene.views.proj, scene.pixels
    refined = refine_points(proj, pixels, start, weights, steps=steps, loss=loss, scale=SCALE)
    assert refined.valid.all()
    before = robust_cost(proj, start, pixels, weights, loss)
    after = robust_cost(proj, refined.points, pixels, weights, loss)
    assert (after <= before + 1e-10).all()  # px^2, rounding at 600 px
    stated = reprojection_residual(proj, refined.points, pixels, weights)
    assert_close(refined.residual, stated, rtol=0, atol=1e-9)  # px
    if loss == "squared":
        at_start = reprojection_residual(proj, start, pixels, weights)
        assert (refined.residual <= at_start + 1e-9).all()  # px, rounding


def test_a_step_that_would_overshoot_is_not_taken() -> None:
    scene, count = right_angle(), 500
    generator = torch.Generator().manual_seed(0)
    start = scene.points + 3 * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    proj, pixels = scene.views.proj, scene.pixels.expand(2, count, 2)
    refined = refine_points(proj, pixels, start)
    kept = (refined.points == start).all(dim=-1) & refined.valid
    assert 10 < kept.sum() < refined.valid.sum()
    ones = torch.ones(2, count).double()
    before = reprojection_residual(proj, start, pixels, ones)
    assert (refined.residual <= before + 1e-9)[refined.valid].all()  # px
    assert (project(scene.views, refined.points).in_front.all(dim=0) == refined.valid).all()


@pytest.mark.parametrize("loss", ["squared", "huber"])  # which have one minimum
def test_a_step_that_was_refused_is_tried_shorter(loss: Loss) -> None:
    """Points far beyond their place, where the first step would go behind the cameras."""
    scene, farther = scene_at(20, num_views=3, count=20), torch.linspace(1, 4, 20).double()
    proj, pixels = scene.views.proj, scene.pixels
    eye = torch.linalg.solve(proj[0, :, :3], -proj[0, :, 3])
    best = refine_points(proj, pixels, scene.points, steps=60, loss=loss, scale=SCALE).points
    start = eye + farther[:, None] * (best - eye)
    once = refine_points(proj, pixels, start, loss=loss, scale=SCALE)
    assert ((once.points == start).all(dim=-1) & once.valid).sum() > 5
    found = refine_points(proj, pixels, start, steps=60, loss=loss, scale=SCALE)
    assert found.valid.all()
    assert_close(found.points, best, rtol=0, atol=1e-6)  # m
    start.requires_grad_(True)
    moved = refine_points(proj, pixels, start, steps=60, loss=loss, scale=SCALE).points
    assert torch.autograd.grad(moved.sum(), start)[0].abs().max() < 1e-3  # of the start


def test_a_step_at_the_optimum_is_taken_whatever_a_view_of_hardly_any_weight_costs() -> None:
    scene, weights = scene_at(20, num_views=3, count=20), torch.ones(3, 20).double()
    proj, pixels = scene.views.proj, scene.pixels.clone()
    weights[2], pixels[2] = 1e-5, 1e10  # px: a cost beside whose rounding that of pixels is none
    best = refine_points(proj, pixels, scene.points, weights, steps=20).points
    pixels.requires_grad_(True)
    moved = refine_points(proj, pixels, best, weights)
    assert moved.valid.all()
    slope = torch.autograd.grad(moved.points.sum(), pixels)[0]
    assert (slope[:2].abs().amax(dim=(0, 2)) > 1e-4).all()  # m / px


@given(scene=posed_scenes(num_views=3), loss=st.sampled_from(LOSSES))
def test_a_point_without_noise_stays(scene: PosedScene, loss: Loss) -> None:
    refined = refine_points(
        scene.views.proj, scene.pixels, scene.points, steps=3, loss=loss, scale=SCALE
    )
    assert refined.valid.all()
    assert_close(refined.points, scene.points, rtol=0, atol=1e-11)  # m
    assert (refined.residual < 1e-9).all()  # px


@given(scene=posed_scenes(num_views=2), offset=vectors(4, within=0.1))
def test_without_noise_the_true_point_is_found(scene: PosedScene, offset: Tensor) -> None:
    refined = refine_points(scene.views.proj, scene.pixels, scene.points + offset, steps=8)
    assert_close(refined.points, scene.points, rtol=0, atol=1e-9)  # m


# What torch.compile does before a compiler sees the graph is what may break.
@pytest.mark.parametrize("backend", ["aot_eager", pytest.param("inductor", marks=pytest.mark.slow)])
def test_a_compiled_step_is_the_same(backend: str) -> None:
    scene = scene_at(30, num_views=3, count=40)
    proj, pixels = scene.views.proj, scene.pixels.clone()
    pixels[1, 3] = torch.nan
    torch.compiler.reset()
    traced = torch.compile(refine_points, fullgraph=True, backend=backend)
    compiled = traced(proj, pixels, scene.points)
    eager = refine_points(proj, pixels, scene.points)
    assert_close(compiled.points, eager.points, rtol=0, atol=1e-9)  # m
    assert_close(compiled.residual, eager.residual, rtol=0, atol=1e-9)  # px
    assert torch.equal(compiled.valid, eager.valid) and eager.valid.sum() == 39


def test_what_cannot_be_refined_comes_back(dtype: torch.dtype) -> None:
    scene = forward_motion(dtype=dtype)
    pixels, points = scene.pixels.repeat(1, 2, 1), scene.points.repeat(2, 1)
    points[1] = torch.tensor([0.0, 0.1, -2.0])  # behind
    points[2, 1] = torch.nan
    pixels[1, 3, 0] = torch.inf
    mask = torch.ones(2, 6, dtype=torch.bool)
    mask[0, 4] = False  # one view left
    weights = torch.ones(2, 6, dtype=dtype)
    inputs = [
        value.clone().requires_grad_() for value in (scene.views.proj, pixels, points, weights)
    ]
    refined = refine_points(*inputs, mask)
    assert refined.valid.tolist() == [True, False, False, False, False, True]
    kept = points.clone()
    kept[2] = 0
    failed = ~refined.valid
    assert torch.equal(refined.points[failed], kept[failed])
    assert (refined.residual[failed] == 0).all()
    gradients = torch.autograd.grad((refined.points.sum() + refined.residual.sum()), inputs)
    assert all(gradient.isfinite().all() for gradient in gradients)
    for gradient in (gradients[1], gradients[3]):
        assert (gradient[:, failed] == 0).all() and (gradient[:, 5] != 0).any()
    assert (gradients[2][failed] == 0).all()


@pytest.mark.parametrize("loss", LOSSES)
def test_without_steps_points_are_judged_where_they_are(loss: Loss) -> None:
    scene = forward_motion()
    points = torch.tensor([[0.1, 0.2, 3.0], [0.1, 0.1, -2.0], [0.0, 0.2, 0.1], [0.0, 0.1, 0.4]])
    points = points.to(scene.points)
    in_front = project(scene.views, points).in_front.all(dim=0)
    assert 0 < in_front.sum() < 4
    pixels = scene.pixels[:, :1].expand(-1, 4, -1)
    judged = refine_points(scene.views.proj, pixels, points, steps=0, loss=loss, scale=SCALE)
    assert torch.equal(judged.valid, in_front)
    assert torch.equal(judged.points, points)
