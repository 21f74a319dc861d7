"""What becomes of points that cannot be triangulated, and of hostile input."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close
from triangulation_cases import NAMED_STATUS, noisy

from deltas_geom import Status, camera_centers, triangulate, triangulate_points
from deltas_geom.testing import DEGENERATE_SCENES, PosedScene, forward_motion, ring
from deltas_geom.testing.strategies import extreme


@given(drawn=noisy(), view=st.integers(0, 2))
def test_status_tells_the_truth(drawn: tuple[PosedScene, Tensor], view: int) -> None:
    scene, weights = drawn
    weights = weights.clone()
    weights[:, 1] = 0
    weights[view, 1] = 1  # one view alone
    weights[:, 2] *= torch.where(torch.arange(3) == view, 1.0, 1e-12)  # as good as alone
    result = triangulate(scene.views.proj, scene.pixels, weights)
    wanted = [Status.OK, Status.TOO_FEW_VIEWS, Status.TOO_FEW_VIEWS, Status.OK]
    assert result.status.tolist() == wanted
    assert (result.valid == (result.status == Status.OK)).all()
    # The other cameras' pixels, mirrored through the centre, meet behind every camera.
    behind = scene._replace(points=2 * camera_centers(scene.views.cam_from_world)[0] - scene.points)
    homogeneous = (
        torch.cat([behind.points, torch.ones(4, 1).double()], dim=-1) @ scene.views.proj.mT
    )
    pixels = homogeneous[..., :2] / homogeneous[..., 2:]
    assert (triangulate(scene.views.proj, pixels).status == Status.BEHIND_CAMERA).all()


@given(pixels=extreme(3, 4, 2), weights=extreme(3, 4), proj=extreme(3, 3, 4), wild=st.booleans())
def test_no_finite_input_gives_nan_or_inf(
    pixels: Tensor, weights: Tensor, proj: Tensor, wild: bool
) -> None:
    rig = ring().views.proj[:3]
    for dtype in (torch.float32, torch.float64):
        # A true gradient of 1e40 does not fit float32: cameras up to 1e7 there.
        power = 0.25 if dtype == torch.float32 else 1
        wild_cameras = proj.sign() * proj.abs() ** power
        cameras = (wild_cameras if wild else rig).to(dtype).requires_grad_()
        places = pixels.to(dtype).requires_grad_()
        # Nor do products of the gradient with a weight of 1e-30.
        shares = (weights.abs() ** power).to(dtype)
        shares.requires_grad_()
        result = triangulate(cameras, places, shares, covariance=True)
        for value in result:
            assert value is not None and value.isfinite().all()
        total = result.points.sum() + result.depth.sum() + result.residual.sum()
        gradients = torch.autograd.grad(total, (places, shares, cameras))
        for gradient in gradients:
            assert gradient.isfinite().all()


@pytest.mark.parametrize("name", DEGENERATE_SCENES)
def test_named_scenes_have_their_status_and_finite_gradients(name: str, dtype: torch.dtype) -> None:
    scene = DEGENERATE_SCENES[name](dtype=dtype)
    proj, pixels = scene.views.proj.requires_grad_(), scene.pixels.clone().requires_grad_()
    result = triangulate(proj, pixels, covariance=True)
    assert (result.status == NAMED_STATUS[name]).all()
    gradients = torch.autograd.grad(result.points.sum() + result.residual.sum(), (proj, pixels))
    for value in (*result, *gradients):
        assert value is not None and value.isfinite().all()
    if NAMED_STATUS[name] == Status.OK:
        assert_close(result.points, scene.points, rtol=1e-5, atol=1e-5)  # m
    else:
        assert (result.points == 0).all() and (result.depth == 0).all()
        assert all((gradient == 0).all() for gradient in gradients)


def test_unequal_weights_do_not_send_a_near_point_to_infinity(dtype: torch.dtype) -> None:
    scene = forward_motion(dtype=dtype)
    weights = torch.tensor([[1.0], [1e-5]], dtype=dtype).expand(2, 3)
    result = triangulate(scene.views.proj, scene.pixels, weights)
    assert (result.status == Status.OK).all()
    assert_close(result.points, scene.points, rtol=0, atol=1e-4)  # m


def test_every_status_explains_itself() -> None:
    for status in Status:
        assert len(status.explanation.split()) >= 4
    assert np.unique([status.explanation for status in Status]).size == len(Status)


@given(drawn=noisy())
def test_a_bad_point_leaves_the_others_alone(drawn: tuple[PosedScene, Tensor]) -> None:
    scene, weights = drawn
    proj, pixels = scene.views.proj.float(), scene.pixels.float()
    spoiled = pixels.clone()
    spoiled[1, 0, 0] = torch.nan
    for weighed in (None, weights.float()):
        found = triangulate(proj, spoiled, weighed)
        assert found.status[0] == Status.NOT_FINITE_INPUT.value
        wanted = triangulate_points(proj, pixels, weighed)
        assert_close(found.points[1:], wanted[1:], rtol=0, atol=1e-5)
