"""How well views tell depth: against triangulation itself."""

import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import PosedViews, Triangulation, project, triangulate
from deltas_nets.network.joint.parallax import parallax_of, relative_error_per_pixel

FOCAL = 300.0


def pair(baseline: float, *, focal: float = FOCAL) -> PosedViews:
    """Two views beside each other, ``(1, 2)``."""
    K = torch.tensor([[focal, 0, 160], [0, focal, 120], [0, 0, 1]], dtype=torch.float64)
    cam_from_world = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    cam_from_world[1, 0, 3] = -baseline
    return PosedViews(K.expand(1, 2, 3, 3), cam_from_world[None])


def ahead(views: PosedViews, depth: float, *, shift: float = 0.0) -> Triangulation:
    """A point in front of the anchor, its match in the source off by ``shift`` px."""
    point = torch.tensor([[[0.0, 0.0, depth]]], dtype=torch.float64)
    pixels = project(views, point).pixels.clone()
    pixels[:, 1, :, 0] += shift
    return triangulate(views.proj, pixels)


def used_of(views: PosedViews) -> Tensor:
    return torch.ones(1, views.K.shape[1] - 1, 1, dtype=torch.bool)


baselines = st.floats(0.03, 0.5)
depths = st.floats(0.5, 8.0)


@given(baselines, depths)
def test_it_is_the_parallax_that_triangulation_states(baseline: float, depth: float) -> None:
    views = pair(baseline)
    points = ahead(views, depth)
    found = parallax_of(views, points, used_of(views))
    # The chord is the angle up to its cube.
    assert_close(found, points.parallax.to(found.dtype), rtol=0.05, atol=1e-6)


@given(baselines, depths)
def test_a_pixel_moves_depth_by_the_stated_share(baseline: float, depth: float) -> None:
    views = pair(baseline)
    points = ahead(views, depth)
    stated = relative_error_per_pixel(views, parallax_of(views, points, used_of(views)))
    near, far = (float(ahead(views, depth, shift=shift).depth[0, 0, 0]) for shift in (0.1, -0.1))
    moved = abs(near - far) / 0.2 / depth
    assert 0.7 < float(stated) / moved < 1.5


@given(baselines, depths, st.floats(0.1, 10.0))
def test_neither_depends_on_the_unit_of_length(baseline: float, depth: float, unit: float) -> None:
    views, scaled = pair(baseline), pair(unit * baseline)
    first = parallax_of(views, ahead(views, depth), used_of(views))
    second = parallax_of(scaled, ahead(scaled, unit * depth), used_of(scaled))
    assert_close(first, second, rtol=1e-4, atol=1e-9)


def test_the_widest_of_the_used_sources_counts() -> None:
    both = PosedViews(
        *(torch.cat(parts, dim=1) for parts in zip(pair(0.1), pair(0.4), strict=True))
    )
    points = ahead(pair(0.1), 2.0)
    wide = parallax_of(both, points, torch.ones(1, 3, 1, dtype=torch.bool))
    narrow = parallax_of(both, points, torch.tensor([True, True, False]).view(1, 3, 1))
    assert_close(wide, parallax_of(pair(0.4), points, used_of(pair(0.4))))
    assert_close(narrow, parallax_of(pair(0.1), points, used_of(pair(0.1))))


def test_where_there_is_no_point_nothing_is_known() -> None:
    views = pair(0.2)
    points = ahead(views, 2.0)
    gone = points._replace(valid=torch.zeros_like(points.valid))
    parallax = parallax_of(views, gone, used_of(views))
    assert float(parallax) == 0
    assert float(relative_error_per_pixel(views, parallax)) == 1
