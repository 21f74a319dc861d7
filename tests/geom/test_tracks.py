"""Triangulation of ragged tracks, against the dense function with padding."""

import time

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from operations import tensors_of
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import PosedViews, ShapeError, Status, triangulate, triangulate_tracks
from deltas_geom.testing import (
    DEGENERATE_SCENES,
    PosedScene,
    default_intrinsics,
    forward_motion,
    right_angle,
    rigid,
    ring,
)
from deltas_geom.testing.strategies import extreme, posed_scenes, vectors

NOISE = 0.5  # px


@st.composite
def seen_by_some(draw: st.DrawFn) -> tuple[PosedScene, Tensor, Tensor]:
    """Five views of six points with noise, weights of 0.2 to 1, and who sees what."""
    scene = draw(posed_scenes(num_views=5, num_points=6))
    noise = draw(vectors(30, within=NOISE, size=2)).reshape(5, 6, 2)
    weights = 0.6 + draw(vectors(5, within=0.4, size=6))
    seen = draw(st.lists(st.booleans(), min_size=30, max_size=30))
    mask = torch.tensor(seen).reshape(5, 6)
    return scene._replace(pixels=scene.pixels + noise), weights, mask


def listed(pixels: Tensor, mask: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels, camera and point of every observation."""
    camera, point = mask.nonzero(as_tuple=True)
    return pixels[camera, point], camera, point


def all_of(scene: PosedScene) -> tuple[Tensor, Tensor, Tensor]:
    return listed(scene.pixels, torch.ones_like(scene.pixels[..., 0], dtype=torch.bool))


def test_wrong_arguments_are_named() -> None:
    proj, pixels, index = torch.zeros(2, 3, 4), torch.zeros(5, 2), torch.zeros(5).long()
    with pytest.raises(ShapeError, match="camera_index has T = 4 but pixels has T = 5"):
        triangulate_tracks(proj, pixels, index[:4], index, 1)
    with pytest.raises(ShapeError, match="weights has T = 1 but pixels has T = 5"):
        triangulate_tracks(proj, pixels, index, index, 1, torch.ones(1))
    with pytest.raises(ShapeError, match=r"proj must have shape \(C, 3, 4\), got \(1, 2, 3, 4\)"):
        triangulate_tracks(proj[None], pixels, index, index, 1)
    with pytest.raises(ShapeError, match=r"camera_index must have shape \(T\), got \(1, 5\)"):
        triangulate_tracks(proj, pixels, index[None], index, 1)
    with pytest.raises(ShapeError, match=r"weights must have shape \(T\), got \(1, 5\)"):
        triangulate_tracks(proj, pixels, index, index, 1, torch.ones(1, 5))
    with pytest.raises(TypeError, match=r"proj must be floating point, got torch\.int64"):
        triangulate_tracks(proj.long(), pixels, index, index, 1)
    with pytest.raises(ValueError, match="num_points must not be negative, got -1"):
        triangulate_tracks(proj, pixels, index, index, -1)
    for cameras, points in ((index + 2, index), (index, index + 1), (index - 1, index)):
        with pytest.raises((IndexError, RuntimeError)):
            triangulate_tracks(proj, pixels, cameras, points, 1)


@given(drawn=seen_by_some(), spoil=st.booleans())
def test_tracks_give_what_the_dense_function_gives(
    drawn: tuple[PosedScene, Tensor, Tensor], spoil: bool
) -> None:
    scene, weights, mask = drawn
    proj = scene.views.proj.clone()
    if spoil:
        mask = mask.clone()
        mask[4] = False
        proj[4] = torch.nan
    wanted = triangulate(proj, scene.pixels, weights, mask)
    pixels, camera, point = listed(scene.pixels, mask)
    result = triangulate_tracks(proj, pixels, camera, point, 6, weights[camera, point])
    assert torch.equal(result.status, wanted.status) and torch.equal(result.valid, wanted.valid)
    assert_close(result.points, wanted.points, rtol=0, atol=1e-9)  # m
    assert_close(result.depth, wanted.depth[camera, point], rtol=0, atol=1e-9)  # m
    assert_close(result.residual, wanted.residual, rtol=0, atol=1e-9)  # px


@given(drawn=seen_by_some(), random=st.randoms(use_true_random=False))
def test_the_order_of_observations_does_not_count(
    drawn: tuple[PosedScene, Tensor, Tensor], random: object
) -> None:
    scene, weights, mask = drawn
    pixels, camera, point = listed(scene.pixels, mask)
    weight = weights[camera, point]
    order = list(range(len(camera)))
    random.shuffle(order)  # type: ignore[attr-defined]
    one = triangulate_tracks(scene.views.proj, pixels, camera, point, 6, weight)
    other = triangulate_tracks(
        scene.views.proj, pixels[order], camera[order], point[order], 6, weight[order]
    )
    assert_close(other.points, one.points, rtol=0, atol=1e-10)  # m
    assert_close(other.depth, one.depth[order], rtol=0, atol=1e-10)
    assert torch.equal(other.status, one.status)


@given(drawn=seen_by_some())
def test_an_observation_of_weight_0_is_one_removed(
    drawn: tuple[PosedScene, Tensor, Tensor],
) -> None:
    scene, weights, mask = drawn
    pixels, camera, point = listed(scene.pixels, mask)
    wanted = triangulate_tracks(scene.views.proj, pixels, camera, point, 6, weights[camera, point])
    everything = scene.pixels.clone()
    everything[~mask] = torch.nan
    pixels, camera, point = all_of(scene._replace(pixels=everything))
    weight = (weights * mask)[camera, point]
    result = triangulate_tracks(scene.views.proj, pixels, camera, point, 6, weight)
    assert torch.equal(result.status, wanted.status)
    assert_close(result.points, wanted.points, rtol=0, atol=1e-10)  # m
    assert_close(result.residual, wanted.residual, rtol=0, atol=1e-9)  # px


@pytest.mark.parametrize("name", DEGENERATE_SCENES)
def test_named_scenes_have_the_status_of_the_dense_function(name: str, dtype: torch.dtype) -> None:
    scene = DEGENERATE_SCENES[name](dtype=dtype)
    wanted = triangulate(scene.views.proj, scene.pixels)
    inputs = [value.clone().requires_grad_() for value in (scene.views.proj, scene.pixels)]
    pixels, camera, point = listed(inputs[1], torch.ones_like(scene.pixels[..., 0]).bool())
    result = triangulate_tracks(inputs[0], pixels, camera, point, wanted.status.shape[0])
    assert torch.equal(result.status, wanted.status)
    assert_close(result.points, wanted.points, rtol=1e-5, atol=1e-5)  # m
    total = result.points.sum() + result.depth.sum() + result.residual.sum()
    assert all(gradient.isfinite().all() for gradient in torch.autograd.grad(total, inputs))


def test_failed_points_say_why_and_get_no_gradient(dtype: torch.dtype) -> None:
    scene = forward_motion(dtype=dtype)
    pixels, camera, point = all_of(scene)
    # Point 1 loses a view, point 2 gets a NaN, point 3 has none, point 4 one camera twice.
    pixels, camera = torch.cat([pixels, pixels[:2]]), torch.cat([camera, torch.tensor([0, 0])])
    point = torch.cat([point, torch.tensor([4, 4])])
    weights = torch.ones(8, dtype=dtype)
    weights[4] = 0
    pixels[5] = torch.nan
    inputs = [value.clone().requires_grad_() for value in (scene.views.proj, pixels, weights)]
    result = triangulate_tracks(inputs[0], inputs[1], camera, point, 5, inputs[2])
    assert [Status(value).name for value in result.status.tolist()] == [
        "OK",
        "TOO_FEW_VIEWS",
        "NOT_FINITE_INPUT",
        "TOO_FEW_VIEWS",
        "NO_PARALLAX",
    ]
    assert (result.points[1:] == 0).all() and (result.depth[point > 0] == 0).all()
    total = result.points.sum() + result.depth.sum() + result.residual.sum()
    gradients = torch.autograd.grad(total, inputs)
    assert all(gradient.isfinite().all() for gradient in gradients)
    assert (gradients[1][point > 0] == 0).all() and (gradients[1][point == 0] != 0).any()


def test_no_observations_and_no_points_are_no_error() -> None:
    none = torch.zeros(0).long()
    proj = forward_motion().views.proj
    empty = triangulate_tracks(proj, torch.zeros(0, 2).double(), none, none, 3)
    assert (empty.status == Status.TOO_FEW_VIEWS).all() and empty.depth.shape == (0,)
    assert triangulate_tracks(proj, torch.zeros(0, 2).double(), none, none, 0).points.numel() == 0


@pytest.mark.parametrize(
    "scene", [forward_motion(), right_angle(), ring()], ids=["fwd", "90", "ring"]
)
def test_gradients_are_right(scene: PosedScene) -> None:
    pixels, camera, point = all_of(scene)
    generator = torch.Generator().manual_seed(0)
    pixels = pixels + torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
    weights = torch.linspace(0.5, 1.5, len(camera)).double()
    inputs = tuple(value.clone().requires_grad_() for value in (scene.views.proj, pixels, weights))

    def solve(proj: Tensor, pixels: Tensor, weights: Tensor) -> list[Tensor]:
        result = triangulate_tracks(proj, pixels, camera, point, 3, weights)
        return [result.points, result.depth, result.residual]

    # Entries of proj are in px: a coarser step keeps rounding below the tolerance.
    assert torch.autograd.gradcheck(solve, inputs, eps=1e-5, atol=1e-5)


@given(pixels=extreme(12, 2), weights=extreme(12), proj=extreme(3, 3, 4), wild=st.booleans())
def test_no_finite_input_gives_nan_or_inf(
    pixels: Tensor, weights: Tensor, proj: Tensor, wild: bool
) -> None:
    camera, point = torch.arange(12) // 4, torch.arange(12) % 4
    for dtype in (torch.float32, torch.float64):
        # True gradients of 1e40 do not fit float32: numbers up to 1e7 there.
        power = 0.25 if dtype == torch.float32 else 1
        inputs = [
            (value.sign() * value.abs() ** power).to(dtype).requires_grad_()
            for value in (proj if wild else ring().views.proj[:3], pixels, weights)
        ]
        result = triangulate_tracks(inputs[0], inputs[1], camera, point, 4, inputs[2])
        assert all(value.isfinite().all() for value in tensors_of(result))
        total = result.points.sum() + result.depth.sum() + result.residual.sum()
        for gradient in torch.autograd.grad(total, inputs):
            assert gradient.isfinite().all()


def test_a_thousand_cameras_and_200_000_observations_take_seconds() -> None:
    generator = torch.Generator().manual_seed(0)
    num_cameras, num_points, length = 1000, 40_000, 5
    # A street: cameras 0.2 m apart, a point in front of each stretch of it.
    pose = rigid(torch.zeros(num_cameras, 3), torch.zeros(num_cameras, 3)).double()
    pose[:, 0, 3] = -0.2 * torch.arange(num_cameras)
    proj = PosedViews(default_intrinsics().expand(num_cameras, 3, 3), pose).proj
    first = torch.randint(0, num_cameras - length, (num_points,), generator=generator)
    points = 4 * torch.rand(num_points, 3, generator=generator, dtype=torch.float64) - 2
    points += torch.tensor([0.4, 0.0, 6.0])
    points[:, 0] += 0.2 * first
    camera = (first[:, None] + torch.arange(length)).flatten()
    point = torch.arange(num_points).repeat_interleave(length)
    seen = (proj[camera, :, :3] @ points[point, :, None]).squeeze(-1) + proj[camera, :, 3]
    pixels = (seen[:, :2] / seen[:, 2:]).requires_grad_()
    start = time.process_time()
    result = triangulate_tracks(proj, pixels, camera, point, num_points)
    gradient = torch.autograd.grad(result.points.sum(), pixels)[0]
    taken = time.process_time() - start
    assert result.valid.all() and gradient.isfinite().all()
    assert_close(result.points, points, rtol=0, atol=1e-8)  # m
    assert taken < 10  # s; 0.1 s where this was written
