"""Triangulation by prepared cameras is triangulation."""

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import PreparedTriangulator, Status, Triangulator, triangulate, triangulate_points
from deltas_geom.testing import ring, seeded_scene

Inputs = tuple[Tensor, Tensor, Tensor]


@pytest.fixture(params=[17, 300], ids=["few", "many"])
def inputs(request: pytest.FixtureRequest, dtype: torch.dtype) -> Inputs:
    scene = seeded_scene(3, num_views=4, num_points=request.param, noise=1.0)
    weights = torch.linspace(0.2, 1, 4 * request.param).view(4, -1)
    return scene.views.proj.to(dtype), scene.pixels.to(dtype), weights.to(dtype)


def test_answers_are_those_of_one_call(inputs: Inputs) -> None:
    proj, pixels, weights = inputs
    rig = Triangulator(covariance=True).prepare(proj)
    mask = torch.ones_like(weights, dtype=torch.bool)
    mask[1, ::3] = False
    for _ in range(2):  # what is kept of the first serves the second
        assert torch.equal(rig.points(pixels, weights), triangulate_points(proj, pixels, weights))
        assert torch.equal(rig.points(pixels), triangulate_points(proj, pixels))
        whole = triangulate(proj, pixels, weights, mask, covariance=True)
        for ours, theirs in zip(rig.full(pixels, weights, mask), whole, strict=True):
            assert ours is not None and torch.equal(ours, theirs)


def test_gradients_reach_the_cameras(inputs: Inputs) -> None:
    leaves = [tensor.clone().requires_grad_() for tensor in inputs]
    rig = PreparedTriangulator(leaves[0])
    for _ in range(2):  # nothing of a graph is kept
        ours = torch.autograd.grad(rig.points(*leaves[1:]).sum(), leaves)
        assert_close(ours, torch.autograd.grad(triangulate_points(*leaves).sum(), leaves))
        ours = torch.autograd.grad(rig.full(*leaves[1:]).residual.sum(), leaves)
        assert_close(ours, torch.autograd.grad(triangulate(*leaves).residual.sum(), leaves))


def test_cameras_that_change_in_place_are_noticed(inputs: Inputs) -> None:
    proj, pixels, weights = (tensor.clone() for tensor in inputs)
    rig = PreparedTriangulator(proj)
    before = rig.points(pixels, weights)
    with torch.no_grad():
        proj[:, :, 3] *= 2  # everything twice as far
    assert torch.equal(rig.points(pixels, weights), triangulate_points(proj, pixels, weights))
    assert not torch.equal(rig.points(pixels, weights), before)


def test_cameras_made_in_inference_mode_are_noticed_too(inputs: Inputs) -> None:
    _, pixels, weights = inputs
    with torch.inference_mode():
        proj = inputs[0].clone()
        rig = PreparedTriangulator(proj)
        rig.points(pixels, weights)
        proj[:, :, 3] *= 2
        assert torch.equal(rig.points(pixels, weights), triangulate_points(proj, pixels, weights))


def test_it_compiles_to_one_graph() -> None:
    scene = ring()
    rig = PreparedTriangulator(scene.views.proj)
    compiled = torch.compile(rig.points, fullgraph=True, backend="eager")
    assert_close(compiled(scene.pixels), rig.points(scene.pixels))


@pytest.mark.parametrize("kinds", [(0, 1), (1, 0), (1, 1)], ids=str)
def test_dtypes_are_those_of_one_call(kinds: tuple[int, int]) -> None:
    scene, dtypes = ring(), (torch.float32, torch.bfloat16)
    proj, pixels = scene.views.proj.to(dtypes[kinds[0]]), scene.pixels.to(dtypes[kinds[1]])
    rig = Triangulator(covariance=True).prepare(proj)
    assert torch.equal(rig.points(pixels), triangulate_points(proj, pixels))
    for ours, theirs in zip(
        rig.full(pixels), triangulate(proj, pixels, covariance=True), strict=True
    ):
        assert ours is not None and theirs is not None
        assert ours.dtype == theirs.dtype and torch.equal(ours, theirs)


def test_it_moves(inputs: Inputs) -> None:
    rig = PreparedTriangulator(inputs[0], frame="world", max_residual=3.0).to(torch.float64)
    double = tuple(tensor.double() for tensor in inputs)
    found = rig.full(*double[1:])
    assert found.points.dtype == torch.float64
    assert_close(found.points, triangulate(*double, frame="world", max_residual=3.0).points)


def test_the_residual_allowed_counts_and_errors_tell_the_view(dtype: torch.dtype) -> None:
    scene = ring(dtype=dtype)
    pixels = scene.pixels.clone()
    pixels[2, 0] += 40  # px: one view is wrong about one point
    found = Triangulator(max_residual=2.0).prepare(scene.views.proj).full(pixels)
    assert found.status[0] == Status.RESIDUAL_TOO_LARGE and (found.points[0] == 0).all()
    assert found.errors[:, 0].argmax() == 2 and found.errors[2, 0] > 5
    assert (found.status[1:] == Status.OK).all() and (found.errors[:, 1:] < 0.01).all()
    with pytest.raises(ValueError, match="max_residual must be positive"):
        triangulate(scene.views.proj, pixels, max_residual=0.0)
