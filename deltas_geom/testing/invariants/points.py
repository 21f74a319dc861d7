"""Invariants of points, in whatever way they are found."""

import torch
from torch import Tensor

from deltas_geom.testing.agreement import POINT_TOLERANCE, assert_near, slack
from deltas_geom.testing.invariants.refinement import residual_of
from deltas_geom.testing.invariants.triangulation import weights_for
from deltas_geom.testing.registry import invariant
from deltas_geom.testing.scenes import PosedScene
from deltas_geom.testing.target import Target


@invariant("points")
def a_pixel_that_is_nan_moves_no_other_point(target: Target, scene: PosedScene) -> None:
    """A pixel that is NaN moves no point but its own, nor that one if its weight is 0."""
    twice = PosedScene(scene.views, scene.points.repeat(2, 1), scene.pixels.repeat(1, 2, 1))
    weights = weights_for(target, twice, None)
    spoiled = twice._replace(pixels=twice.pixels.clone())
    spoiled.pixels[-1, 0] = torch.nan
    if weights is not None and scene.views.num_views > 2:
        weights[-1, 1] = 0
        spoiled.pixels[-1, 1] = torch.nan
    found = _found(target, spoiled, weights)
    for name, wanted in _found(target, twice, weights).items():
        assert_near(found[name][1:], wanted[1:], POINT_TOLERANCE, f"m ({name})", "point")


@invariant("fit")
def no_point_beside_fits_better(target: Target, scene: PosedScene, *, step: float = 0.01) -> None:
    """No point beside a refined or robust one (1 cm) has a smaller weighted residual in px."""
    weights = weights_for(target, scene, None)
    for name, found in _found(target, scene, weights).items():
        if name == "triangulate":
            continue  # what it makes least is algebraic
        least = residual_of(scene, found, weights)
        for beside in step * torch.cat([torch.eye(3), -torch.eye(3)]).to(found):
            fits = residual_of(scene, found + beside, weights)
            better = fits < least - 1e-8 * slack()
            if bool(better.any()):
                point = int(better.nonzero()[0])
                raise AssertionError(
                    f"{name}: point {point} has {float(least[point]):.9g} px, and "
                    f"{float(fits[point]):.9g} px if moved by {beside.tolist()} m"
                )


def _found(target: Target, scene: PosedScene, weights: Tensor | None) -> dict[str, Tensor]:
    """The points, by the name of each way that the target offers."""
    (views, start, pixels), found = scene, {}
    if target.triangulate is not None:
        found["triangulate"] = target.triangulate(views.proj, pixels, weights)
    if target.refine is not None:
        found["refine"] = target.refine(views.proj, pixels, start, weights)
    if target.robust is not None:  # so many px that no view is wrong
        found["robust"], _ = target.robust(views.proj, pixels, weights, 16.0)
    return found
