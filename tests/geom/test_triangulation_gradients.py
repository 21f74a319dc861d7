"""Gradients of triangulated points: right, also where an SVD has none."""

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close
from triangulation_cases import svd_points

from deltas_geom import triangulate_points
from deltas_geom.testing import PosedScene, right_angle, ring

pytestmark = pytest.mark.usefixtures("way")


def test_second_derivatives_are_right_off_the_ties() -> None:
    scene = right_angle()

    def solve(pixels: Tensor) -> Tensor:
        return triangulate_points(scene.views.proj, pixels)

    pixels = (scene.pixels + torch.tensor([3.0, -2.0])).requires_grad_()
    assert torch.autograd.gradgradcheck(solve, (pixels,), eps=1e-3, atol=1e-6)


@pytest.mark.parametrize("scene", [right_angle(), ring()], ids=["90 degrees", "ring"])
def test_at_exact_ties_svd_has_no_gradient(scene: PosedScene) -> None:
    pixels = scene.pixels.clone().requires_grad_()
    weights = torch.ones_like(scene.pixels[..., 0])
    by_svd = torch.autograd.grad(svd_points(scene.views.proj, pixels, weights).sum(), pixels)[0]
    assert by_svd.isnan().any()
    ours = torch.autograd.grad(triangulate_points(scene.views.proj, pixels).sum(), pixels)[0]
    assert ours.isfinite().all() and (ours != 0).any()


def test_a_singular_camera_that_is_masked_spoils_no_gradient() -> None:
    scene = ring()
    proj = scene.views.proj.clone()
    proj[3] = 0
    proj.requires_grad_()
    mask = torch.tensor([True, True, True, False])[:, None]
    points = triangulate_points(proj, scene.pixels, mask=mask)
    assert_close(points, scene.points, rtol=0, atol=1e-12)  # m
    assert torch.autograd.grad(points.sum(), proj)[0].isfinite().all()
