"""Triangulation of ragged tracks, against the dense function with padding."""

import time

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import PosedViews, ShapeError, Status, triangulate, triangulate_tracks
from deltas_geom.testing import (
    PosedScene,
    default_intrinsics,
    forward_motion,
    rigid,
)
from deltas_geom.testing.strategies import posed_scenes, vectors

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
    with pytest.raises(ValueError, match="num_points must be 0 or more, got -1"):
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


def test_a_camera_that_saw_a_point_twice_has_no_baseline_with_itself(dtype: torch.dtype) -> None:
    scene = forward_motion(dtype=dtype)
    pixels, index = scene.pixels[0, [0, 0, 1]], torch.tensor([0, 0, 1])
    result = triangulate_tracks(scene.views.proj, pixels, torch.zeros(3).long(), index, 3)
    few = Status.TOO_FEW_VIEWS
    assert result.status.tolist() == [Status.NO_PARALLAX, few, few]


def test_no_observations_and_no_points_are_no_error() -> None:
    none = torch.zeros(0).long()
    proj = forward_motion().views.proj
    empty = triangulate_tracks(proj, torch.zeros(0, 2).double(), none, none, 3)
    assert (empty.status == Status.TOO_FEW_VIEWS).all() and empty.depth.shape == (0,)
    assert triangulate_tracks(proj, torch.zeros(0, 2).double(), none, none, 0).points.numel() == 0


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


def test_no_observation_counts_of_a_point_that_is_not_finite() -> None:
    scene, proj = forward_motion(), forward_motion().views.proj
    pixels, weights = scene.pixels[:, :2].flatten(0, 1).clone(), torch.ones(2 * len(proj)).double()
    camera, point = torch.arange(len(proj)).repeat_interleave(2), torch.arange(2).repeat(len(proj))
    pixels[0] = torch.nan
    weights[1] = 0
    found = triangulate_tracks(proj, pixels, camera, point, 2, weights)
    assert found.used.tolist() == [False, False, *(n == 1 for n in point[2:].tolist())]
