"""Every solver of points by the same named inputs, and the two ways in which one of them solves."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from hypothesis import strategies as st
from operations import OPERATIONS, Inputs, Operation, chosen
from torch import Tensor
from torch.testing import assert_close

import deltas_geom as geom
from deltas_geom import PosedViews
from deltas_geom.testing import PosedScene, rigid
from deltas_geom.testing.strategies import posed_scenes, vectors
from deltas_geom.triangulation import triangulate as dispatch

WAYS = ("short", "long")
NOISE = 0.5  # px
BY_VIEW = {"poses", "proj", "pixels", "rays", "weights", "mask"}
BY_VIEW |= {"depth", "inliers", "errors", "used"}
"""Inputs and fields of results of which each view has its own."""
SEEN = ("pixels", "rays", "weights")
Fields = dict[str, Tensor]


@contextmanager
def by(way: str) -> Iterator[None]:
    """All points one way: "short", which few take, or "long"."""
    few = dispatch.FEW
    dispatch.FEW = few if way == "short" else 0
    try:
        yield
    finally:
        dispatch.FEW = few


class Solver(NamedTuple):
    """A solver of named inputs.

    Attributes:
        operation: of inputs of :func:`inputs_of`.
        views: how many it is given.
        robust: a gross outlier of each point is no harm.
    """

    operation: Operation
    views: int = 3
    robust: bool = False

    def __call__(self, inputs: Inputs) -> Fields:
        """The fields of the result by name, those that are None left out."""
        result: Any = self.operation(**chosen(self.operation, inputs))
        if isinstance(result, Tensor):
            return {"points": result}
        return {name: value for name, value in result._asdict().items() if value is not None}

    def takes(self, name: str) -> bool:
        """Is this one of its inputs?"""
        return name in chosen(self.operation, dict.fromkeys(_NAMES, torch.zeros(())))


_NAMES = ("poses", "proj", "pixels", "rays", "weights", "mask", "points")
_OTHERS = {
    "triangulate_robust": {"views": 5, "robust": True},
    "triangulate_robust_rays": {"views": 5, "robust": True},
    "triangulate_robust_tracks": {"views": 5, "robust": True},
    "triangulate_two_view": {"views": 2},
}
SOLVERS = {
    name: Solver(operation, **_OTHERS.get(name, {}))
    for name, operation in OPERATIONS.items()
    if name.startswith(("triangulate", "refine"))
}


def long_way(solver: Solver) -> Solver:
    """The same, the long way."""

    def operation(proj: Tensor, pixels: Tensor, weights: Tensor, mask: Tensor) -> Any:
        with by("long"):
            return solver.operation(proj, pixels, weights, mask)

    return solver._replace(operation=operation)


SOLVERS["triangulate, long"] = long_way(SOLVERS["triangulate"])
SOLVERS["triangulate_points, long"] = long_way(SOLVERS["triangulate_points, weights"])


def inputs_of(scene: PosedScene, weights: Tensor | None = None) -> Inputs:
    """What cameras see of points; the points are where refinement starts."""
    pixels = scene.pixels
    rays = geom.pixel_rays(scene.views.K, pixels)
    known = pixels.isfinite().all(dim=-1)
    return {
        "K": scene.views.K,
        "poses": scene.views.cam_from_world,
        "proj": scene.views.proj,
        "pixels": pixels,
        "rays": torch.where(known[..., None], rays, torch.nan),
        "weights": torch.ones_like(pixels[..., 0]) if weights is None else weights,
        "mask": torch.ones_like(known),
        "points": scene.points,
    }


@st.composite
def sights(
    draw: st.DrawFn, num_views: int, *, noise: float = NOISE, outliers: bool = False
) -> Inputs:
    """Views of four points, whose pixels are off by up to ``noise`` and weigh 0.5 to 1.

    Refinement starts up to 5 cm beside the points.

    Args:
        draw: given by hypothesis.
        num_views: V.
        noise: px.
        outliers: one view of each point is wrong by 50 px or more, across the rows: cameras side
            by side have these for epipolar lines within 0.7 rad, so that no other view can agree.
            Which they are is an input more, ``(V, N)``.
    """
    scene = draw(posed_scenes(num_views=num_views))
    off = draw(vectors(num_views * 4, within=noise, size=2)).reshape(num_views, 4, 2)
    which: Inputs = {}
    if outliers:
        wrong = torch.tensor(draw(st.lists(st.integers(0, num_views - 1), min_size=4, max_size=4)))
        up = 2.0 * torch.tensor(draw(st.lists(st.booleans(), min_size=4, max_size=4))) - 1
        aside = torch.stack([draw(vectors(1, within=20.0, size=4))[0], 50 * up], dim=-1)
        which = {"outliers": torch.arange(num_views)[:, None] == wrong}
        off = off + aside * which["outliers"][..., None]
    weights = 0.75 + draw(vectors(num_views, within=0.25, size=4))
    found = inputs_of(scene._replace(pixels=scene.pixels + off), weights)
    return found | which | {"points": scene.points + draw(vectors(4, within=0.05))}


def of_views(values: dict[str, Tensor], views: list[int]) -> dict[str, Tensor]:
    """Inputs or fields of some views, in their order; two-view pixels are both."""
    # Their dim, from the end: of what points have it lies before theirs.
    dims = {"poses": -3, "proj": -3, "pixels": -3, "rays": -3}
    return {
        name: value.index_select(dims.get(name, -2), torch.tensor(views))
        if name in BY_VIEW
        else value
        for name, value in values.items()
    }


def moved(inputs: Inputs, turn: Tensor, shift: Tensor, scale: float) -> Inputs:
    """The world turned, shifted and then scaled."""
    new_from_world = rigid(turn, shift)
    poses = inputs["poses"] @ torch.linalg.inv(new_from_world)
    poses[..., :3, 3] *= scale
    points = inputs["points"] @ new_from_world[:3, :3].mT + new_from_world[:3, 3]
    return inputs | {
        "poses": poses,
        "proj": PosedViews(inputs["K"], poses).proj,
        "points": scale * points,
    }


def spoilt(inputs: Inputs, view: int, *, camera: bool) -> Inputs:
    """A view that saw nothing, and whose camera may be unknown."""
    names = ("pixels", "rays", *(("poses", "proj") if camera else ()))
    bad = {name: inputs[name].clone() for name in names}
    for tensor in bad.values():
        tensor[view] = torch.nan
    return inputs | bad


def assert_same(
    found: Fields,
    wanted: Fields,
    *,
    atol: float = 1e-9,
    where: Callable[[str], bool] = lambda name: True,
) -> None:
    """All fields: m, px and rad; of covariances the share of the largest."""
    assert found.keys() == wanted.keys()
    for name, theirs in wanted.items():
        ours = found[name]
        assert ours.shape == theirs.shape and ours.dtype == theirs.dtype, name
        if not where(name):
            continue
        if not theirs.is_floating_point():
            assert torch.equal(ours, theirs), name
            continue
        size = float(theirs.detach().abs().max()) if name == "covariance" else 1.0
        assert_close(ours, theirs, rtol=0, atol=atol * size, msg=lambda m, n=name: f"{n}: {m}")
