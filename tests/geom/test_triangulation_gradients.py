"""Gradients of triangulated points: right, also where an SVD has none."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close
from triangulation_cases import NAMED_STATUS, noisy, svd_points

from deltas_geom import Status, triangulate, triangulate_points
from deltas_geom.testing import DEGENERATE_SCENES, PosedScene, forward_motion, right_angle, ring


@given(drawn=noisy(), view=st.integers(0, 2))
def test_a_masked_view_and_a_failed_point_get_no_gradient(
    drawn: tuple[PosedScene, Tensor], view: int
) -> None:
    scene, weights = drawn
    mask = torch.ones(3, 4, dtype=torch.bool)
    mask[view, :2] = False
    pixels = scene.pixels.clone()
    pixels[view, 0] = torch.nan  # masked: harmless
    pixels[0 if view else 1, 3] = torch.inf  # used: the point fails
    inputs = [value.clone().requires_grad_() for value in (scene.views.proj, pixels, weights)]
    result = triangulate(*inputs, mask, covariance=True)
    assert result.status[3] == Status.NOT_FINITE_INPUT and (result.points[3] == 0).all()
    total = result.points.sum() + result.depth.sum() + result.residual.sum()
    of_proj, of_pixels, of_weights = torch.autograd.grad(total, inputs)
    assert of_proj.isfinite().all()
    for gradient in (of_pixels, of_weights):
        assert gradient.isfinite().all()
        assert (gradient[view, :2] == 0).all() and (gradient[:, 3] == 0).all()
        assert (gradient[:, 2] != 0).any()


@pytest.mark.parametrize("frame", ["rig", "world"])
@pytest.mark.parametrize(
    "scene", [forward_motion(), right_angle(), ring()], ids=["fwd", "90", "ring"]
)
def test_gradients_are_right_where_svds_are_nan_too(scene: PosedScene, frame: str) -> None:
    inputs = tuple(
        value.clone().requires_grad_()
        for value in (scene.views.proj, scene.pixels, torch.ones_like(scene.pixels[..., 0]))
    )

    def solve(proj: Tensor, pixels: Tensor, weights: Tensor) -> Tensor:
        return triangulate_points(proj, pixels, weights, frame=frame)  # type: ignore[arg-type]

    # Entries of proj are in px: a coarser step keeps rounding below the tolerance.
    assert torch.autograd.gradcheck(solve, inputs, eps=1e-5, atol=1e-6)


@pytest.mark.parametrize("frame", ["rig", "world"])
@pytest.mark.parametrize("kind", [torch.float32, torch.float64])
@given(drawn=noisy(), view=st.integers(0, 2), far=st.sampled_from([0.0, 1000.0]))
def test_the_gradient_of_points_is_the_whole_computations(
    kind: torch.dtype, frame: str, drawn: tuple[PosedScene, Tensor], view: int, far: float
) -> None:
    scene, weights = drawn
    mask = torch.ones(3, 4, dtype=torch.bool)
    mask[view, 0] = False
    pixels = scene.pixels.clone()
    pixels[view, 0] = torch.nan  # masked: harmless
    pixels[0 if view else 1, 3] = torch.inf  # used: the point fails
    proj = scene.views.proj.clone()
    proj[..., 3] -= far * proj[..., 0]  # the world's origin is elsewhere
    inputs = tuple(x.to(kind).requires_grad_() for x in (proj, pixels, weights))

    def solve(*inputs: Tensor) -> Tensor:
        return triangulate_points(*inputs, mask, frame=frame)  # type: ignore[arg-type]

    share = torch.arange(1.0, 13.0, dtype=kind).view(4, 3)
    short = torch.autograd.grad(solve(*inputs), inputs, share)
    _, pull = torch.func.vjp(solve, *(x.detach() for x in inputs))  # derives all that is computed
    for ours, whole in zip(short, pull(share), strict=True):
        size = 1 + whole.abs().max().item()
        bound = 1e-8 if kind == torch.float64 else 1e-6
        assert_close(ours, whole, rtol=0, atol=bound * size)
    assert (short[1][view, 0] == 0).all() and (short[1][:, 3] == 0).all()


@pytest.mark.parametrize("name", DEGENERATE_SCENES)
def test_points_that_fail_have_no_gradient(name: str, dtype: torch.dtype) -> None:
    scene = DEGENERATE_SCENES[name](dtype=dtype)
    proj, pixels = scene.views.proj.requires_grad_(), scene.pixels.clone().requires_grad_()
    gradients = torch.autograd.grad(triangulate_points(proj, pixels).sum(), (proj, pixels))
    for gradient in gradients:
        assert gradient.isfinite().all()
        assert (gradient != 0).any() == (NAMED_STATUS[name] == Status.OK)


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
