"""Invariants of what is said of triangulated points: whether there are any, and why not."""

import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import to_homogeneous
from deltas_geom.cameras.poses import camera_centers
from deltas_geom.status import Status
from deltas_geom.testing.agreement import assert_status
from deltas_geom.testing.invariants.triangulation import weights_for
from deltas_geom.testing.registry import invariant
from deltas_geom.testing.scenes import PosedScene
from deltas_geom.testing.target import Target

_SMALLEST_PARALLAX = 1e-5  # rad: the named scenes have none, but for rounding of float32


@invariant("judge", scenes="named")
def the_status_is_what_the_geometry_says(target: Target, scene: PosedScene) -> None:
    """Points are valid unless at infinity, behind a camera, or seen without parallax."""
    equal = weights_for(target, scene, torch.ones_like(scene.pixels[..., 0]))
    _assert_judged(_status(target, scene, equal), true_status(scene))


@invariant("judge")
def points_in_front_of_all_cameras_are_valid(
    target: Target, scene: PosedScene, *, weights: Tensor | None = None
) -> None:
    """Noise of a pixel makes no point invalid that is well in front of the cameras."""
    found = _status(target, scene, weights_for(target, scene, weights))
    _assert_judged(found, torch.full_like(found, Status.OK, dtype=torch.int8))


@invariant("judge")
def mirrored_points_are_behind(target: Target, scene: PosedScene) -> None:
    """Pixels whose rays meet behind the cameras have no point."""
    center = camera_centers(scene.views.cam_from_world)[0]
    mirrored = to_homogeneous(2 * center - scene.points) @ scene.views.proj.mT
    behind = scene._replace(pixels=mirrored[..., :2] / mirrored[..., 2:])
    found = _status(target, behind, weights_for(target, scene, None))
    _assert_judged(found, torch.full_like(found, Status.BEHIND_CAMERA, dtype=torch.int8))


@invariant("judge")
def a_pixel_that_is_nan_spoils_its_point_alone(
    target: Target, scene: PosedScene, *, spoil: float = torch.nan
) -> None:
    """A used pixel that is not finite makes its point invalid, and no other."""
    extended = scene._replace(pixels=scene.pixels.repeat(1, 2, 1))
    extended.pixels[-1, 0, 0] = spoil
    found = _status(target, extended, weights_for(target, extended, None))
    wanted = torch.full_like(found, Status.OK, dtype=torch.int8)
    wanted[0] = Status.NOT_FINITE_INPUT
    _assert_judged(found, wanted)


@invariant("judge", "weights")
def one_view_is_too_few(target: Target, scene: PosedScene, *, view: int = 0) -> None:
    """A point of which one view alone has a weight has no depth."""
    weights = torch.zeros_like(scene.pixels[..., 0])
    weights[view] = 1
    found = _status(target, scene, weights)
    _assert_judged(found, torch.full_like(found, Status.TOO_FEW_VIEWS, dtype=torch.int8))


@invariant("judge", "weights", "many views")
def a_view_of_weight_0_may_be_nan(target: Target, scene: PosedScene, *, view: int = -1) -> None:
    """The pixels of a view of weight 0 do not count for the status, be they NaN."""
    weights = torch.ones_like(scene.pixels[..., 0])
    weights[view] = 0
    spoiled = scene.pixels.clone()
    spoiled[view] = torch.nan
    found = _status(target, scene._replace(pixels=spoiled), weights)
    _assert_judged(found, torch.full_like(found, Status.OK, dtype=torch.int8))


def true_status(scene: PosedScene) -> Tensor:
    """``(N)`` int8: the status of a scene's points, from the points themselves.

    Example:
        >>> from deltas_geom.testing import on_baseline
        >>> Status(int(true_status(on_baseline()))).name
        'NO_PARALLAX'
    """
    finite = scene.points.isfinite().all(dim=-1)
    points = torch.where(finite[:, None], scene.points, 0.0).double()
    rays = points - camera_centers(scene.views.cam_from_world.double())[:, None]
    first, others = rays[:1], rays[1:]
    across = torch.linalg.cross(first.expand_as(others), others).norm(dim=-1)
    along = (first * others).sum(dim=-1)
    # Through 0 and 180 degrees alike: a point between two cameras has no parallax either.
    angle = torch.atan2(across, along.abs()).amax(dim=0)
    depth = (to_homogeneous(points) @ scene.views.proj.double().mT)[..., 2]
    status = torch.full_like(finite, Status.OK, dtype=torch.int8)
    for failed, reason in (
        ((depth <= 0).any(dim=0), Status.BEHIND_CAMERA),
        (angle < _SMALLEST_PARALLAX, Status.NO_PARALLAX),
        (~finite, Status.AT_INFINITY),
    ):
        status = torch.where(failed, torch.full_like(status, reason), status)
    return status


def _status(target: Target, scene: PosedScene, weights: Tensor | None) -> Tensor:
    assert target.judge is not None
    return target.judge(scene.views.proj, scene.pixels, weights)


def _assert_judged(found: Tensor, wanted: Tensor) -> None:
    assert_status(found, wanted, (Status.OK,))
