"""Gradients of refined points, through the steps and of the optimum."""

from typing import Literal

import pytest
import torch
from refinement_cases import LOSSES, SCALE, scene_at
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import refine_points, triangulate_points
from deltas_geom.testing import PosedScene, forward_motion, right_angle, ring
from deltas_geom.triangulation.refine import Loss


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("steps", [1, 2])
@pytest.mark.parametrize(
    "scene", [forward_motion(), right_angle(), ring()], ids=["fwd", "90", "ring"]
)
def test_gradients_are_right(scene: PosedScene, steps: int, loss: Loss) -> None:
    generator = torch.Generator().manual_seed(1)
    noise = torch.randn(scene.pixels.shape, generator=generator, dtype=torch.float64)
    start = scene.points + torch.tensor([0.02, -0.03, 0.04])
    # Not 0, where the slope of the square root in the loss jumps, and not 1.
    weights = torch.linspace(0.5, 1.5, noise[..., 0].numel()).double().reshape(noise.shape[:-1])
    inputs = tuple(
        value.clone().requires_grad_()
        for value in (scene.views.proj, scene.pixels + noise, start, weights)
    )

    def solve(proj: Tensor, pixels: Tensor, points: Tensor, weights: Tensor) -> list[Tensor]:
        refined = refine_points(proj, pixels, points, weights, steps=steps, loss=loss, scale=SCALE)
        return [refined.points, refined.residual]

    assert refine_points(*inputs, steps=steps, loss=loss, scale=SCALE).valid.all()
    assert torch.autograd.gradcheck(solve, inputs, eps=1e-5, atol=1e-5, fast_mode=True)


def test_at_the_optimum_the_gradient_is_that_of_the_optimum() -> None:
    scene = forward_motion()
    pixels = scene.pixels.clone().requires_grad_()
    points = refine_points(scene.views.proj, pixels, scene.points).points
    step = 1e-3
    for coordinate in range(3):
        gradient = torch.autograd.grad(points[0, coordinate], pixels, retain_graph=True)[0]
        moved = scene.pixels.clone()
        moved[1, 0, 0] += step
        there = refine_points(scene.views.proj, moved, scene.points, steps=20).points
        measured = (there[0, coordinate] - scene.points[0, coordinate]) / step
        assert_close(gradient[1, 0, 0], measured, rtol=1e-2, atol=1e-6)


def converged(loss: Loss) -> tuple[list[Tensor], int]:
    """Inputs whose residuals are not small, and the steps after which their points stay."""
    scene = scene_at(30, num_views=4, count=2)
    weights = torch.linspace(0.5, 1.5, 8).double().reshape(4, 2)
    start = triangulate_points(scene.views.proj, scene.pixels, weights)
    return [scene.views.proj, scene.pixels, start, weights], 12 if loss == "squared" else 100


@pytest.mark.parametrize("loss", LOSSES)
def test_implicit_gradients_are_those_of_the_optimum(loss: Loss) -> None:
    inputs, steps = converged(loss)
    inputs = [value.clone().requires_grad_() for value in inputs]

    def solve(*given: Tensor, gradient: Literal["unrolled", "implicit"]) -> list[Tensor]:
        refined = refine_points(*given, steps=steps, loss=loss, scale=SCALE, gradient=gradient)
        return [refined.points, refined.residual]

    implicit = solve(*inputs, gradient="implicit")
    unrolled = solve(*inputs, gradient="unrolled")
    proj, pixels, start, weights = inputs
    total = [sum(value.sin().sum() for value in found) for found in (implicit, unrolled)]
    gradients = [torch.autograd.grad(value, inputs) for value in total]
    assert all(map(torch.equal, implicit, unrolled))
    for one, other in zip(*gradients, strict=True):
        assert_close(one, other, rtol=1e-7, atol=1e-9)
    assert (gradients[0][2] == 0).all()
    assert torch.autograd.gradcheck(
        lambda proj, pixels, weights: solve(
            proj, pixels, start.detach(), weights, gradient="implicit"
        ),
        (proj, pixels, weights),
        eps=1e-5,
        atol=1e-5,
        fast_mode=True,
    )


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("gradient", ["unrolled", "implicit"])
def test_transforms_derive_the_same(gradient: Literal["unrolled", "implicit"], loss: Loss) -> None:
    inputs, _ = converged(loss)

    def solve(*given: Tensor) -> Tensor:
        return refine_points(*given, steps=4, loss=loss, scale=SCALE, gradient=gradient).points

    wanted = torch.autograd.functional.jacobian(solve, tuple(inputs))
    everything = (0, 1, 2, 3)
    for derive in (torch.func.jacrev, torch.func.jacfwd):
        for found, expected in zip(derive(solve, everything)(*inputs), wanted, strict=True):
            assert_close(found, expected, rtol=1e-9, atol=1e-11)
    one_by_one = torch.func.vmap(solve, in_dims=(None, 2, 0, 2))(
        inputs[0], inputs[1].unsqueeze(1), inputs[2].unsqueeze(1), inputs[3].unsqueeze(1)
    )
    assert_close(one_by_one.squeeze(1), solve(*inputs), rtol=0, atol=1e-12)  # m


def test_implicit_gradients_are_0_where_there_is_no_minimum() -> None:
    scene = scene_at(30, num_views=2, count=1)
    # Far beyond the scale a Cauchy loss bends down: from there no step is an optimum.
    pixels = (scene.pixels + torch.tensor([[[40.0, 30]], [[-50.0, 60]]])).requires_grad_()
    refined = refine_points(
        scene.views.proj, pixels, scene.points, steps=0, loss="cauchy", gradient="implicit"
    )
    assert refined.valid.all()
    assert (torch.autograd.grad(refined.points.sum(), pixels)[0] == 0).all()
