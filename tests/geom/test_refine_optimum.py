"""Where Gauss-Newton refinement ends: at the minimum that scipy finds."""

import numpy as np
import pytest
import scipy.optimize
import torch
from refinement_cases import LOSSES, SCALE, robust_cost, scene_at
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import refine_points, triangulate, triangulate_points
from deltas_geom.triangulation.refine import Loss


def best_point(proj: Tensor, pixels: Tensor, weights: Tensor, start: Tensor, loss: Loss) -> Tensor:
    """scipy's minimiser of the same cost for one point: proj (V, 3, 4), pixels (V, 2)."""
    cameras, seen, shares = proj.numpy(), pixels.numpy(), weights.numpy()

    def residuals(point: np.ndarray) -> np.ndarray:
        projected = cameras @ np.append(point, 1.0)
        errors = projected[:, :2] / projected[:, 2:] - seen
        squared = np.maximum((errors**2).sum(axis=1), 1e-30)
        value = squared
        if loss == "huber":
            value = np.where(squared > SCALE**2, 2 * SCALE * squared**0.5 - SCALE**2, squared)
        elif loss == "cauchy":
            value = SCALE**2 * np.log1p(squared / SCALE**2)
        return ((shares * np.sqrt(value / squared))[:, None] * errors).ravel()

    found = scipy.optimize.least_squares(
        residuals, start.numpy(), jac="3-point", xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    point = torch.from_numpy(found.x)

    def cost(place: Tensor) -> Tensor:
        return robust_cost(proj, place[None], pixels[:, None], weights[:, None], loss).sum()

    # scipy stops where the cost's digits end, at half those of the point: one Newton step more.
    gradient = torch.autograd.functional.jacobian(cost, point)
    hessian = torch.autograd.functional.hessian(cost, point)
    step = torch.linalg.solve(hessian, gradient)
    assert step.norm() < 1e-5  # m
    return point - step


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("angle", [5, 30, 80])
def test_the_answer_is_scipys(angle: float, loss: Loss) -> None:
    scene = scene_at(angle, num_views=4, count=8)
    proj, pixels = scene.views.proj, scene.pixels
    weights = torch.linspace(0.5, 2, 32).double().reshape(4, 8)
    start = triangulate_points(proj, pixels, weights)
    # The re-weighting converges linearly.
    steps = 8 if loss == "squared" else 400
    refined = refine_points(proj, pixels, start, weights, steps=steps, loss=loss, scale=SCALE)
    for point in range(8):
        wanted = best_point(proj, pixels[:, point], weights[:, point], refined.points[point], loss)
        found = refined.points[point]
        distance = 4.0  # m, from the cameras
        assert_close(found, wanted, rtol=0, atol=1e-8 * distance)


@pytest.mark.parametrize("angle", [1, 3, 10, 30])
@pytest.mark.parametrize("num_views", [2, 5])
def test_one_step_from_the_rig_frame_is_the_optimum(angle: float, num_views: int) -> None:
    scene = scene_at(angle, num_views=num_views, count=500)
    start = triangulate(scene.views.proj, scene.pixels)
    one = refine_points(scene.views.proj, scene.pixels, start.points)
    optimum = refine_points(scene.views.proj, scene.pixels, start.points, steps=30)
    assert one.valid.float().mean() > 0.99
    cost = one.residual[one.valid].square().mean()
    assert cost <= (1 + 1e-3) * optimum.residual[one.valid].square().mean()


def test_a_robust_loss_ignores_a_wrong_view() -> None:
    scene = scene_at(30, num_views=6, count=20)
    pixels = scene.pixels.clone()
    pixels[2] += 40.0  # px
    start = triangulate_points(scene.views.proj, pixels)
    plain = refine_points(scene.views.proj, pixels, start, steps=20)
    robust = refine_points(scene.views.proj, pixels, start, steps=20, loss="cauchy")
    off = (robust.points - scene.points).norm(dim=-1).median()
    assert off < 0.02 < 0.05 < (plain.points - scene.points).norm(dim=-1).median()  # m
