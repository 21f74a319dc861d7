"""Outliers, refinement and covariance of ragged tracks, against the dense functions point by point.

What holds of all solvers is in test_solvers.py.
"""

from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from test_tracks import all_of, listed, seen_by_some
from torch import Tensor
from torch.testing import assert_close

import deltas_geom as geom
from deltas_geom import Status
from deltas_geom.testing import PosedScene, forward_motion
from deltas_geom.triangulation import track_groups

Drawn = tuple[PosedScene, Tensor, Tensor]
POSES = 1e-6 * torch.eye(6).double().expand(5, 6, 6)


def by_tracks(drawn: Drawn, order: Any = slice(None)) -> dict[str, Any]:
    """All three, of observations in this order; of each observation in that of the mask."""
    scene, weights, mask = drawn
    pixels, camera, point = (x[order] for x in listed(scene.pixels, mask))
    proj, weight, back = scene.views.proj, weights[camera, point], torch.arange(len(camera))
    back[order] = torch.arange(len(camera))
    robust = geom.triangulate_robust_tracks(proj, pixels, camera, point, 6, weight, covariance=True)
    refined = geom.refine_tracks(proj, pixels, scene.points + 0.02, camera, point, weight, steps=3)
    noise = geom.track_covariance(proj, scene.points, camera, point, weight, pose_covariance=POSES)
    fields = {
        name: field[back] if len(field) == len(back) and name in ("used", "depth") else field
        for name, field in robust._asdict().items()
    }
    return fields | {"refined": refined, "noise": noise}


@given(drawn=seen_by_some(), wrong=st.integers(0, 4), few=st.sampled_from([1, 2, 2**14]))
def test_they_give_what_the_dense_functions_give(drawn: Drawn, wrong: int, few: int) -> None:
    scene, weights, mask = drawn
    scene.pixels[wrong, ::2, 1] += 80  # px
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(track_groups, "_OBSERVATIONS", few)
        found = by_tracks(drawn)
    seen = scene.views.proj, scene.pixels
    robust = geom.triangulate_robust(*seen, weights, mask, covariance=True)
    assert torch.equal(found["used"], robust.inliers[mask])
    assert torch.equal(found["status"], robust.status)
    assert robust.covariance is not None
    size = 1e-9 * (1 + float(robust.covariance.abs().max()))
    for name in ("points", "residual", "covariance"):
        assert_close(found[name], getattr(robust, name), rtol=0, atol=size, msg=name)
    refined = geom.refine_points(*seen, scene.points + 0.02, weights, mask, steps=3)
    assert torch.equal(found["refined"].valid, refined.valid)
    assert_close(found["refined"].points, refined.points, rtol=0, atol=1e-9)  # m
    assert_close(found["refined"].residual, refined.residual, rtol=0, atol=1e-9)  # px
    noise = geom.point_covariance(seen[0], scene.points, weights, mask=mask, pose_covariance=POSES)
    assert_close(found["noise"], noise, rtol=0, atol=1e-9 * (1e-9 + float(noise.abs().max())))


@given(drawn=seen_by_some(), random=st.randoms(use_true_random=False))
def test_the_order_of_observations_does_not_count(drawn: Drawn, random: Any) -> None:
    order = list(range(int(drawn[2].sum())))
    random.shuffle(order)
    found, wanted = by_tracks(drawn, order), by_tracks(drawn)
    for name in ("status", "used", "refined", "noise"):
        assert_close(found[name], wanted[name], rtol=0, atol=0, msg=name)
    assert_close(
        found["points"], wanted["points"], rtol=0, atol=1e-9
    )  # m; sums in the list's order


def test_points_of_one_observation_or_none_say_so_and_get_no_gradient() -> None:
    scene = forward_motion()
    pixels, camera, point = all_of(scene)
    keep = (point != 2) & ~((point == 1) & (camera == 1))
    pixels, camera, point = pixels[keep].requires_grad_(), camera[keep].int(), point[keep].int()
    proj, ones = scene.views.proj.requires_grad_(), torch.ones(len(camera)).double()
    robust = geom.triangulate_robust_tracks(proj, pixels, camera, point, 3)
    few = Status.TOO_FEW_VIEWS
    assert robust.status.tolist() == [Status.OK, few, few]
    assert torch.equal(robust.used, point == 0)
    refined = geom.refine_tracks(proj, pixels, scene.points, camera, point)
    assert refined.valid.tolist() == [True, False, False]
    assert torch.equal(refined.points[1:], scene.points[1:]) and (refined.residual[1:] == 0).all()
    noise = geom.track_covariance(proj, scene.points, camera, point, ones)
    assert (noise[0].diagonal() > 0).all() and (noise[1:] == 0).all()
    total = robust.points.sum() + refined.points.sum() + refined.residual.square().sum()
    of_proj, of_pixels = torch.autograd.grad(total + noise.sum(), (proj, pixels))
    assert of_proj.isfinite().all() and (of_pixels[point > 0] == 0).all()
    assert (of_pixels[point == 0] != 0).any()


@pytest.mark.parametrize("cameras", [0, 2])
@pytest.mark.parametrize("points", [0, 3])
def test_no_observations_and_no_points_are_no_error(cameras: int, points: int) -> None:
    none, proj = torch.zeros(0).long(), torch.ones(cameras, 3, 4)
    start, pixels = torch.ones(points, 3), torch.zeros(0, 2)
    found = geom.triangulate_robust_tracks(proj, pixels, none, none, points, covariance=True)
    assert found.status.tolist() == [Status.TOO_FEW_VIEWS] * points and len(found.used) == 0
    refined = geom.refine_tracks(proj, pixels, start, none, none)
    assert torch.equal(refined.points, start) and not refined.valid.any()
    noise = geom.track_covariance(proj, start, none, none, pixels[:, 0])
    assert torch.equal(noise, torch.zeros(points, 3, 3))


@pytest.mark.parametrize("kind", [torch.uint8, torch.int8, torch.int16, torch.int32])
def test_indices_are_integers_of_any_size(kind: torch.dtype) -> None:
    scene = forward_motion()
    pixels, camera, point = all_of(scene)
    proj, ones = scene.views.proj, torch.ones(len(camera)).double()

    def found(camera: Tensor, point: Tensor) -> tuple[Tensor, ...]:
        robust = geom.triangulate_robust_tracks(proj, pixels, camera, point, 3)
        refined = geom.refine_tracks(proj, pixels, scene.points, camera, point)
        poses = POSES[: len(proj)]
        noise = (
            geom.track_covariance(proj, scene.points, camera, point, ones, pose_covariance=known)
            for known in (None, poses)
        )
        return robust.points, robust.within_depth((0.1, 100.0)).points, refined.points, *noise

    for ours, wanted in zip(
        found(camera.to(kind), point.to(kind)), found(camera, point), strict=True
    ):
        assert torch.equal(ours, wanted)


def test_wrong_arguments_are_named() -> None:
    proj, pixels, index = torch.ones(2, 3, 4), torch.ones(5, 2), torch.zeros(5).long()
    points, ones = torch.ones(1, 3), torch.ones(5)
    for camera, point in ((index + 2, index), (index, index + 1), (index - 1, index)):
        for call in (
            lambda c, p: geom.triangulate_robust_tracks(proj, pixels, c, p, 1),
            lambda c, p: geom.refine_tracks(proj, pixels, points, c, p),
            lambda c, p: geom.track_covariance(proj, points, c, p, ones),
        ):
            with pytest.raises(IndexError, match=r"\w+_index must be from 0 to [01]"):
                call(camera, point)
    with pytest.raises(geom.ShapeError, match=r"points must have shape \(N, 3\), got \(1, 1, 3\)"):
        geom.refine_tracks(proj, pixels, points[None], index, index)
    with pytest.raises(geom.ShapeError, match="pose_covariance has C = 3 but proj has C = 2"):
        geom.track_covariance(proj, points, index, index, ones, pose_covariance=torch.ones(3, 6, 6))
    with pytest.raises(TypeError, match="point_index must hold integers"):
        geom.refine_tracks(proj, pixels, points, index, ones)
    with pytest.raises(ValueError, match="threshold must be positive"):
        geom.triangulate_robust_tracks(proj, pixels, index, index, 1, threshold=0.0)
