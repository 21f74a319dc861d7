"""Values at hand are weighed in NumPy as tensors are in torch; their points start no threads."""

import math
import warnings

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close
from torch.utils._python_dispatch import TorchDispatchMode

from deltas_geom import triangulate_points
from deltas_geom.numerics.sums import SERIAL
from deltas_geom.testing.fixed_scenes import seeded_scene
from deltas_geom.triangulation.dlt import normal_coefficients, normal_matrix
from deltas_geom.triangulation.observed import clean_pixels, observe
from deltas_geom.triangulation.weights import weigh

SIZES = [0.0, 1e-9, 1e-6, 1.0, -2.0, 1e200, math.inf, -math.inf, math.nan]


@given(
    pixels=st.lists(st.sampled_from([0.0, 3.0, -7e5, 1e60, math.inf, math.nan]), min_size=24),
    sizes=st.none() | st.lists(st.sampled_from(SIZES), min_size=12),
    used=st.none() | st.lists(st.booleans(), min_size=12),
)
def test_both_weigh_alike(
    pixels: list[float], sizes: list[float] | None, used: list[bool] | None
) -> None:
    where = torch.tensor(pixels[:24], dtype=torch.float64).reshape(3, 4, 2)
    weights = None if sizes is None else torch.tensor(sizes[:12], dtype=torch.float64).reshape(3, 4)
    mask = None if used is None else torch.tensor(used[:12]).reshape(3, 4)
    found = observe(where, weights, mask, torch.Size())
    x, y, sound = clean_pixels(where)
    wanted = weigh(weights, mask, batch=torch.Size(), like=where, sound=sound)
    assert_close((found.x, found.y), (x, y))
    good = wanted.sound.expand(4)
    assert torch.equal(found.weights.sound.expand(4), good)
    assert torch.equal(found.weights.used.expand(3, 4), wanted.used.expand(3, 4))
    assert torch.equal(found.weights.unused.expand(3, 4), wanted.unused.expand(3, 4))
    for ours, theirs in (
        (found.weights.squared, wanted.squared),
        (found.weights.largest, wanted.largest),
    ):
        assert_close(*(some.expand(-1, 4)[:, good] for some in (ours, theirs)))


@pytest.mark.parametrize("weighted", [False, True])
def test_both_sum_the_same_normal_matrix(weighted: bool) -> None:
    scene = seeded_scene(3, num_views=4, num_points=50)
    x, y = scene.pixels.unbind(dim=-1)
    squared = torch.rand(4, 50, dtype=torch.float64) if weighted else None
    of = normal_coefficients(scene.views.proj, None if weighted else torch.ones(4, 1).double())
    found = normal_matrix(of, x, y, squared)
    wanted = normal_matrix(of.clone().requires_grad_(), x, y, squared)
    assert_close(torch.stack(found), torch.stack(wanted).detach(), rtol=1e-12, atol=0)


class Longest(TorchDispatchMode):
    """Which operations compute more numbers at a time than torch takes in the calling thread."""

    def __init__(self) -> None:
        super().__init__()
        self.found: dict[str, int] = {}

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):  # type: ignore[no-untyped-def]
        found = func(*args, **(kwargs or {}))
        shared = any(
            r.alias_info is not None and not r.alias_info.is_write for r in func._schema.returns
        )
        if isinstance(found, Tensor) and not shared and found.numel() > SERIAL:
            self.found[str(func)] = found.numel()
        return found


# They hand memory over, or copy it piece by piece.
NO_THREADS = {
    "aten.new_empty.default",
    "aten.lift_fresh.default",
    "aten.detach.default",
    "aten.cat.default",
}


@pytest.mark.parametrize("views", [2, 5, 9])
@pytest.mark.parametrize("given", ["pixels", "weights", "mask", "NaN"])
def test_points_of_many_views_start_no_threads(given: str, views: int) -> None:
    scene = seeded_scene(0, num_views=views, num_points=1)
    pixels = scene.pixels.float().repeat(1, 70_000, 1)
    pixels[0, 0] = math.nan if given == "NaN" else 1.0
    weights = torch.full(pixels.shape[:-1], 0.5) if given in ("weights", "NaN") else None
    mask = torch.ones(pixels.shape[:-1], dtype=torch.bool) if given == "mask" else None
    if mask is not None:
        mask[1, 7] = False
    with Longest() as longest:
        triangulate_points(scene.views.proj.float(), pixels, weights, mask)
    assert set(longest.found) <= NO_THREADS


def test_a_batch_that_weights_alone_have_is_kept() -> None:
    scene = seeded_scene(0, num_views=3, num_points=300)
    weights = torch.rand(2, 3, 300) + 0.1
    found = triangulate_points(scene.views.proj.float(), scene.pixels.float(), weights)
    for one, weight in zip(found, weights, strict=True):
        alone = triangulate_points(scene.views.proj.float(), scene.pixels.float(), weight)
        np.testing.assert_allclose(one, alone, rtol=1e-6)


@pytest.mark.parametrize("weighted", [False, True])
def test_what_fails_is_told_by_its_status_and_by_no_warning_of_numpy(weighted: bool) -> None:
    scene = seeded_scene(0, num_views=3, num_points=300)
    proj = scene.views.proj.float()[:1].expand(3, 3, 4)  # one camera, three times
    pixels = scene.pixels.float().clone()
    pixels[0, :100] = math.inf
    pixels[:, 100:200] = 1e18
    weights = torch.rand(3, 300).clamp(min=1e-30) if weighted else None
    if weights is not None:
        weights[1, ::7] = math.inf
        weights[2, ::5] = math.nan
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert torch.isfinite(triangulate_points(proj, pixels, weights)).all()
