"""Convex upsampling: what it promises, what it starts as, its place in the densifier."""

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from torch import Tensor

from deltas_geom import ShapeError, SparseDepth
from deltas_nets.network.lite.convex_upsampling import (
    ConvexUpsampling,
    bilinear_logits,
    convex_upsample,
)
from deltas_nets.network.lite.densifier import Densifier
from deltas_nets.network.lite.efficientnet import EfficientNetLite0

WIDTHS = (8, 8, 8, 8)


def drawn(
    draw: st.DrawFn, shape: tuple[int, ...], within: float, dtype: torch.dtype = torch.float64
) -> Tensor:
    numbers = st.floats(-within, within, width=32)
    return torch.from_numpy(draw(arrays.arrays("float64", shape, elements=numbers))).to(dtype)


@st.composite
def maps(draw: st.DrawFn, within: float = 3.0) -> Tensor:
    """Coarse maps ``(1, 1, h, w)``, down to a single cell."""
    return drawn(draw, (1, 1, draw(st.integers(1, 5)), draw(st.integers(1, 6))), within)


@st.composite
def maps_and_logits(draw: st.DrawFn, within: float = 9.0) -> tuple[Tensor, Tensor]:
    """Coarse maps and logits of whatever weights, from even to nearly one of nine."""
    coarse = draw(maps())
    return coarse, drawn(draw, (1, 36, *coarse.shape[-2:]), within)


def untrained_logits(coarse: Tensor) -> Tensor:
    return bilinear_logits().to(coarse.dtype).view(1, 36, 1, 1).expand(1, 36, *coarse.shape[-2:])


# Shapes and errors.


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ShapeError, match=r"logits must have shape \(\*B, 36, h, w\)"):
        convex_upsample(torch.zeros(1, 1, 4, 5), torch.zeros(1, 9, 4, 5))
    with pytest.raises(ShapeError, match="logits has w = 6 but coarse has w = 5"):
        convex_upsample(torch.zeros(1, 1, 4, 5), torch.zeros(1, 36, 4, 6))


@pytest.mark.parametrize("half", [torch.float16, torch.bfloat16])
def test_the_dtype_is_that_of_the_map(dtype: torch.dtype, half: torch.dtype) -> None:
    coarse, logits = torch.rand(2, 3, 4, 5, dtype=dtype), torch.rand(2, 36, 4, 5)
    fine = convex_upsample(coarse, logits)
    assert fine.dtype == dtype
    assert fine.shape == (2, 3, 8, 10)
    narrow = convex_upsample(coarse.to(half), logits.to(half))
    assert narrow.dtype == half
    torch.testing.assert_close(narrow.to(dtype), fine, rtol=0.02, atol=0.02)


# Invariants.


@given(drawn=maps_and_logits())
def test_every_pixel_is_within_the_range_of_its_neighbours(drawn: tuple[Tensor, Tensor]) -> None:
    coarse, logits = drawn
    fine = convex_upsample(coarse, logits)
    padded = F.pad(coarse, (1, 1, 1, 1), mode="replicate")
    highest, lowest = F.max_pool2d(padded, 3, 1), -F.max_pool2d(-padded, 3, 1)
    above, below = (F.interpolate(bound, scale_factor=2) for bound in (highest, lowest))
    assert (fine <= above + 1e-12).all()
    assert (fine >= below - 1e-12).all()


@given(drawn=maps_and_logits(within=1e4), value=st.floats(-3, 3))
def test_a_constant_stays_that_constant(drawn: tuple[Tensor, Tensor], value: float) -> None:
    coarse, logits = drawn
    fine = convex_upsample(torch.full_like(coarse, value), logits)
    torch.testing.assert_close(fine, torch.full_like(fine, value), rtol=1e-12, atol=1e-12)


@given(drawn=maps_and_logits(), scale=st.floats(-2, 2), offset=st.floats(-2, 2))
def test_another_unit_before_is_another_unit_after(
    drawn: tuple[Tensor, Tensor], scale: float, offset: float
) -> None:
    coarse, logits = drawn
    torch.testing.assert_close(
        convex_upsample(scale * coarse + offset, logits),
        scale * convex_upsample(coarse, logits) + offset,
        rtol=0,
        atol=1e-12,
    )


@given(drawn=maps_and_logits(), down=st.integers(0, 3), right=st.integers(0, 3))
def test_a_shift_by_a_cell_is_a_shift_by_two_pixels(
    drawn: tuple[Tensor, Tensor], down: int, right: int
) -> None:
    coarse, logits = drawn
    shifted = convex_upsample(
        F.pad(coarse, (right, 0, down, 0), mode="replicate"),
        F.pad(logits, (right, 0, down, 0), mode="replicate"),
    )
    fine = convex_upsample(coarse, logits)
    torch.testing.assert_close(shifted[..., 2 * down :, 2 * right :], fine, rtol=0, atol=1e-12)


@given(drawn=maps_and_logits())
def test_a_mirrored_map_with_mirrored_weights_is_mirrored(drawn: tuple[Tensor, Tensor]) -> None:
    coarse, logits = drawn
    each = logits.view(1, 2, 2, 3, 3, *logits.shape[-2:])
    mirrored = each.flip(2, 4, -1).flatten(1, 4)
    torch.testing.assert_close(
        convex_upsample(coarse.flip(-1), mirrored),
        convex_upsample(coarse, logits).flip(-1),
        rtol=0,
        atol=1e-12,
    )


@given(drawn=maps_and_logits(within=1e4))
def test_gradients_are_finite_whatever_the_weights(drawn: tuple[Tensor, Tensor]) -> None:
    coarse, logits = (tensor.float().requires_grad_() for tensor in drawn)
    fine = convex_upsample(coarse, logits)
    fine.square().sum().backward()
    for tensor in (fine, coarse.grad, logits.grad):
        assert tensor is not None
        assert tensor.isfinite().all()


# Oracles.


@given(coarse=maps())
def test_it_starts_as_bilinear_up_to_the_border(coarse: Tensor) -> None:
    fine = convex_upsample(coarse, untrained_logits(coarse))
    bilinear = F.interpolate(coarse, scale_factor=2, mode="bilinear", align_corners=False)
    # The five faint neighbours of a pixel may be as far off as the map's extremes.
    step = float(coarse.max() - coarse.min())
    torch.testing.assert_close(fine, bilinear, rtol=0, atol=5.1e-4 * step + 1e-6)


@given(drawn=maps_and_logits())
def test_it_is_the_mixture_that_unfold_gives(drawn: tuple[Tensor, Tensor]) -> None:
    coarse, logits = drawn
    height, width = coarse.shape[-2:]
    patches = F.unfold(F.pad(coarse, (1, 1, 1, 1), mode="replicate"), 3)
    weights = logits.view(2, 2, 9, height, width).softmax(dim=2)
    expected = torch.einsum("yxkhw,khw->hywx", weights, patches.view(9, height, width))
    torch.testing.assert_close(
        convex_upsample(coarse, logits)[0, 0],
        expected.reshape(2 * height, 2 * width),
        rtol=0,
        atol=1e-12,
    )


def test_gradients_are_those_of_finite_differences() -> None:
    random = torch.Generator().manual_seed(0)
    coarse = torch.rand(1, 2, 2, 3, generator=random, dtype=torch.float64, requires_grad=True)
    logits = torch.randn(1, 36, 2, 3, generator=random, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(convex_upsample, (coarse, logits))


# Examples.


def test_a_step_between_cells_can_stay_a_step() -> None:
    coarse = torch.tensor([0.0, 0.0, 1.0, 1.0]).expand(1, 1, 4, 4)
    own_cell = torch.zeros(4, 9)
    own_cell[:, 4] = 200.0  # the others underflow
    fine = convex_upsample(coarse, own_cell.view(1, 36, 1, 1).expand(1, 36, 4, 4))
    assert torch.equal(fine[0, 0, 0], torch.tensor([0.0, 0, 0, 0, 1, 1, 1, 1]))


def test_maps_share_the_weights() -> None:
    coarse, logits = torch.rand(2, 3, 4, 5), torch.randn(2, 36, 4, 5)
    apart = [convex_upsample(one, logits) for one in coarse.split(1, dim=1)]
    assert torch.equal(convex_upsample(coarse, logits), torch.cat(apart, dim=1))


def test_every_weight_of_the_untrained_head_learns() -> None:
    torch.manual_seed(0)
    head = ConvexUpsampling(6)
    logits = head(torch.rand(1, 6, 5, 7))
    assert torch.equal(logits, untrained_logits(logits))
    convex_upsample(torch.rand(1, 1, 5, 7), logits).square().sum().backward()
    for parameter in head.parameters():
        assert parameter.grad is not None
        assert (parameter.grad != 0).all()


# In the densifier.


@pytest.fixture(scope="module")
def densifier() -> Densifier:
    torch.manual_seed(0)
    return Densifier(WIDTHS, EfficientNetLite0.channels).eval()


@given(height=st.integers(32, 48), width=st.integers(32, 48))
def test_the_finest_map_is_as_large_as_the_image(
    densifier: Densifier, height: int, width: int
) -> None:
    encoder = EfficientNetLite0().eval()
    empty = torch.zeros(1, 1, height, width)
    with torch.no_grad():
        features = encoder(torch.rand(1, 1, 3, height, width))
        dense = densifier(features, SparseDepth(empty, empty))
    assert dense.log_depth[0].shape == dense.log_spread.shape == (1, 1, height, width)
    sizes = [scale.shape[-2:] for scale in dense.log_depth[1:]]
    assert sizes == [(-(-height // stride), -(-width // stride)) for stride in (4, 8, 16)]
    assert dense.log_spread.min() >= -6
    assert dense.log_spread.max() <= 2


def test_doubt_does_not_move_the_edges_of_depth() -> None:
    densifier = Densifier(WIDTHS, EfficientNetLite0.channels)
    features = EfficientNetLite0()(torch.rand(1, 1, 3, 48, 64))
    empty = torch.zeros(1, 1, 48, 64)
    densifier(features, SparseDepth(empty, empty)).log_spread.sum().backward()
    assert all(parameter.grad is None for parameter in densifier.upsampling.parameters())
    assert all(parameter.grad is not None for parameter in densifier.spread.parameters())
