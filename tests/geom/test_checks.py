"""Every shape error says what was expected and what was given."""

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from deltas_geom import Lens, ShapeError, pixel_grid, rasterize_depth, undistort_image
from deltas_geom.checks import (
    batch_shape,
    check_bool,
    check_counts,
    check_depth_range,
    check_image_size,
    check_shapes,
)


def test_a_wrong_trailing_dim_is_named() -> None:
    with pytest.raises(ShapeError, match=r"pixels must have shape \(\*B, N, 2\), got \(7, 3\)"):
        check_shapes(pixels=(torch.zeros(7, 3), "N 2"))


def test_too_few_dims_are_named() -> None:
    with pytest.raises(ShapeError, match=r"K must have shape \(\*B, 3, 3\), got \(3,\)"):
        check_shapes(K=(torch.zeros(3), "3 3"))


def test_a_letter_has_one_size_in_all_tensors() -> None:
    with pytest.raises(ShapeError, match="weights has V = 2 but proj has V = 3"):
        check_shapes(proj=(torch.zeros(3, 3, 4), "V 3 4"), weights=(torch.zeros(2, 5), "V N"))


class Symbol(torch.SymInt):
    """A size of a program that is exported: it has no value yet."""

    def __init__(self) -> None: ...

    def __lt__(self, other: object) -> bool:
        return False


@pytest.mark.parametrize("count", [2, np.int32(2), torch.tensor(2), (2, 3), Symbol()], ids=type)
def test_a_count_may_be_of_any_whole_kind_and_a_symbol(count: Any) -> None:
    check_counts(2, count=count)


def test_leading_dims_are_free() -> None:
    check_shapes(a=(torch.zeros(8, 1, 5, 2), "N 2"), b=(torch.zeros(5, 3), "N 3"))


def test_batch_dims_broadcast() -> None:
    assert batch_shape((2, 1), (3,), ()) == (2, 3)


@given(shapes=st.lists(st.lists(st.integers(0, 3), max_size=4).map(tuple), max_size=4))
def test_batch_dims_broadcast_as_those_of_torch(shapes: list[tuple[int, ...]]) -> None:
    try:
        wanted = torch.broadcast_shapes(*shapes)
    except RuntimeError:
        with pytest.raises(ShapeError, match="must broadcast"):
            batch_shape(*shapes)
    else:
        assert batch_shape(*shapes) == wanted


def test_the_first_call_imports_nothing_large() -> None:
    # torch.broadcast_shapes, for one, imports sympy, for half a second.
    code = """
import sys, torch
from deltas_geom import PosedViews, sample_inv_depths, triangulate_points
views = PosedViews(torch.eye(3).expand(2, 3, 3), torch.eye(4).expand(2, 4, 4))
sample_inv_depths(views, torch.zeros(5, 2), torch.ones(3), image_size=(4, 4))
triangulate_points(views.proj, torch.zeros(2, 5, 2))
sys.exit('sympy' in sys.modules)
"""
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("depth_range", [(0, 1), (2, 1), (-1, 1), (1, 1), (float("nan"), 1)])
def test_a_depth_range_is_positive_and_ordered(depth_range: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="0 < near < far"):
        check_depth_range(depth_range)


def test_far_may_be_infinite() -> None:
    check_depth_range((0.5, float("inf")))


def test_an_image_has_a_pixel() -> None:
    with pytest.raises(ValueError, match="height, width"):
        check_image_size((0, 3))


@pytest.mark.parametrize("size", [(4.0, 6), (4, 6.5), (np.float32(4), 6), (np.float64(4), 6)])
def test_an_image_has_a_whole_number_of_pixels(size: tuple[int, int]) -> None:
    pixels = torch.zeros(5, 2)
    lens = Lens(torch.eye(3), torch.zeros(1), "SIMPLE_RADIAL")
    for use in (
        lambda: rasterize_depth(pixels, torch.ones(5), image_size=size),
        lambda: undistort_image(lens, torch.zeros(1, 4, 6), new_size=size),
        lambda: pixel_grid(size),
    ):
        with pytest.raises(TypeError, match=r"image_size must hold whole numbers, got .*: use int"):
            use()
    check_image_size((np.int64(4), 6))  # type: ignore[arg-type]


def test_a_plus_asks_for_one_or_more() -> None:
    check_shapes(weights=(torch.zeros(3, 0), "+V N"))
    with pytest.raises(ShapeError, match=r"weights must have V >= 1, got \(0, 3\)"):
        check_shapes(weights=(torch.zeros(0, 3), "+V N"))
    with pytest.raises(ShapeError, match=r"map must have shape \(\*B, D, h\), got \(2,\)"):
        check_shapes(map=(torch.zeros(2), "D +h"))


def test_masks_are_bool_and_indices_are_integers() -> None:
    check_bool(mask=None, used=torch.ones(2, dtype=torch.bool))
    check_shapes(point_index=(torch.ones(2, dtype=torch.int32), "T"))
    for wrong in (torch.ones(2), torch.ones(2, dtype=torch.int64)):
        with pytest.raises(
            TypeError, match=r"mask must be bool, True = used, got torch\..*: use mask != 0"
        ):
            check_bool(mask=wrong)
    for wrong in (torch.ones(2), torch.ones(2, dtype=torch.bool)):
        with pytest.raises(TypeError, match="point_index must hold integers, got torch"):
            check_shapes(point_index=(wrong, "T"))
