"""Invariants of refinement: moving points closer to the pixels."""

import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import to_homogeneous
from deltas_geom.cameras.projection import project
from deltas_geom.testing.agreement import POINT_TOLERANCE, assert_near, slack
from deltas_geom.testing.invariants.triangulation import weights_for
from deltas_geom.testing.registry import invariant
from deltas_geom.testing.scenes import PosedScene
from deltas_geom.testing.target import Target


@invariant("refine")
def refined_points_fit_no_worse(
    target: Target,
    scene: PosedScene,
    *,
    weights: Tensor | None = None,
    start: Tensor | None = None,
) -> None:
    """The weighted residual in px is never larger after refining than before."""
    weights = weights_for(target, scene, weights)
    start = scene.points if start is None else start
    before = residual_of(scene, start, weights)
    after = residual_of(scene, _refined(target, scene, start, weights), weights)
    worse = after > before + 1e-8 * slack()  # px
    if bool(worse.any()):
        point = int(worse.nonzero()[0])
        raise AssertionError(
            f"point {point}: {float(after[point]):.9g} px after {float(before[point]):.9g} px"
        )


@invariant("refine")
def an_exact_point_is_not_moved(
    target: Target, scene: PosedScene, *, weights: Tensor | None = None
) -> None:
    """Refining a point whose projections are the pixels leaves it where it is."""
    weights = weights_for(target, scene, weights)
    exact = scene._replace(pixels=project(scene.views, scene.points).pixels)
    found = _refined(target, exact, scene.points, weights)
    assert_near(found, scene.points, POINT_TOLERANCE, "m", "point")


def _refined(target: Target, scene: PosedScene, start: Tensor, weights: Tensor | None) -> Tensor:
    assert target.refine is not None
    return target.refine(scene.views.proj, scene.pixels, start, weights)


def residual_of(scene: PosedScene, points: Tensor, weights: Tensor | None) -> Tensor:
    """``(N)`` weighted RMS distance of the projections from the pixels, px."""
    seen = to_homogeneous(points) @ scene.views.proj.mT
    distance = (seen[..., :2] / seen[..., 2:] - scene.pixels).square().sum(dim=-1)
    squared = torch.ones_like(distance) if weights is None else weights.square()
    return ((squared * distance).sum(dim=0) / squared.sum(dim=0)).sqrt()
