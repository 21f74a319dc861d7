"""Normal matrices of the equations of pixels, and their 3x3 solves."""

import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from deltas_geom.numerics.symmetric3 import inverse3, solve3
from deltas_geom.numerics.vectors import Symmetric3
from deltas_geom.testing.strategies import extreme, scales, vectors
from deltas_geom.triangulation.dlt import normal_coefficients, normal_matrix, rows
from deltas_geom.triangulation.uncertainty import unpacked3

EPS = torch.finfo(torch.float64).eps


def packed(matrix: Tensor) -> Symmetric3:
    """Six ``(*B)`` of symmetric ``(*B, 3, 3)``."""
    rows, columns = torch.triu_indices(3, 3)
    m00, m01, m02, m11, m12, m22 = matrix[..., rows, columns].unbind(dim=-1)
    return m00, m01, m02, m11, m12, m22


def rows_of(proj: Tensor, x: Tensor, y: Tensor, squared: Tensor) -> Tensor:
    """The weighted equations ``(*B, N, 2 V, K)``, one by one."""
    places = torch.stack([x, y], dim=-1)  # (*B, V, N, 2)
    equations = places[..., None] * proj[..., None, 2:, :] - proj[..., None, :2, :]
    weighted = squared.sqrt()[..., None, None] * equations
    return weighted.transpose(-4, -3).flatten(-3, -2)


@st.composite
def seen(draw: st.DrawFn, views: int = 3, points: int = 4) -> tuple[Tensor, ...]:
    """Cameras of any 12 numbers, pixels and squared weights, some of them 0."""
    proj = draw(vectors(views, within=2.0, size=12)).reshape(views, 3, 4)
    x, y = draw(vectors(2, within=3.0, size=views * points)).reshape(2, views, points)
    squared = draw(vectors(views, within=1.0, size=points)).clamp(min=0)
    return proj, x, y, squared


@st.composite
def definite(draw: st.DrawFn, *, decades: float = 3.0) -> Tensor:
    """``(3, 3)`` symmetric, with eigenvalues 0.1 to 1 times a factor."""
    basis, _ = torch.linalg.qr(2 * torch.eye(3).double() + draw(vectors(3, within=0.6)))
    values = 0.55 + draw(vectors(1, within=0.45))[0]
    return (basis * values) @ basis.mT * draw(scales(decades=decades))


@given(drawn=seen())
@pytest.mark.parametrize("columns", [3, 4])
def test_it_is_the_square_of_the_rows(columns: int, drawn: tuple[Tensor, ...]) -> None:
    proj, x, y, squared = drawn
    equations = rows_of(proj[..., :columns], x, y, squared)
    wanted = equations.mT @ equations
    found = normal_matrix(normal_coefficients(proj[..., :columns]), x, y, squared)
    alike = normal_matrix(normal_coefficients(proj[..., :columns], squared[:, :1]), x, y)
    upper = torch.triu_indices(columns, columns)
    assert len(found) == columns * (columns + 1) // 2
    assert_close(torch.stack(found, dim=-1), wanted[:, upper[0], upper[1]], rtol=0, atol=1e-12)
    equations = rows_of(proj[..., :columns], x, y, squared[:, :1].expand_as(x))
    wanted = equations.mT @ equations
    assert_close(torch.stack(alike, dim=-1), wanted[:, upper[0], upper[1]], rtol=0, atol=1e-12)


@given(drawn=seen())
def test_the_rows_are_the_books(drawn: tuple[Tensor, ...]) -> None:
    proj, x, y, squared = drawn
    seen = torch.stack([x, y], dim=-1).transpose(0, 1)  # (N, V, 2)
    found = rows(proj, seen)
    assert (found.numpy() == rows(proj.numpy(), seen.numpy())).all()
    weighted = (found * squared.sqrt().mT[..., None, None]).flatten(-3, -2)
    assert_close(weighted, rows_of(proj, x, y, squared), rtol=0, atol=1e-14)


@given(drawn=seen(), factor=scales(decades=20))
def test_squared_weights_multiply_it(drawn: tuple[Tensor, ...], factor: float) -> None:
    proj, x, y, squared = drawn
    coefficients = normal_coefficients(proj)
    found = torch.stack(normal_matrix(coefficients, x, y, factor * squared))
    wanted = torch.stack(normal_matrix(coefficients, x, y, squared))
    assert_close(found / factor, wanted, rtol=0, atol=1e-12)


@given(matrix=definite(decades=100), x=vectors(1, within=2.0))
def test_solving_undoes_multiplying(matrix: Tensor, x: Tensor) -> None:
    right = (x @ matrix)[0]
    b0, b1, b2 = right
    found, is_definite = solve3(packed(matrix), (b0, b1, b2))
    assert is_definite
    # The condition is 10 at most, and the solution 4 long.
    assert_close(torch.stack(found), x[0], rtol=0, atol=100 * EPS)
    wanted = torch.linalg.solve(matrix, right)
    assert_close(torch.stack(found), wanted, rtol=0, atol=100 * EPS)


@given(matrix=definite())
def test_the_inverse_is_that_of_torch(matrix: Tensor) -> None:
    found = unpacked3(inverse3(packed(matrix)))
    wanted = torch.linalg.inv(matrix)
    assert_close(found, wanted, rtol=0, atol=100 * EPS * float(wanted.abs().max()))
    assert_close(found @ matrix, torch.eye(3).double(), rtol=0, atol=100 * EPS)


@given(matrix=definite(), x=vectors(1, within=2.0))
def test_the_inverse_solves(matrix: Tensor, x: Tensor) -> None:
    b0, b1, b2 = x[0]
    solved, _ = solve3(packed(matrix), (b0, b1, b2))
    by_inverse = unpacked3(inverse3(packed(matrix))) @ x[0]
    assert_close(torch.stack(solved), by_inverse, rtol=1e-12, atol=1e-12 * float(by_inverse.norm()))


# Its second pivot is small, so that rounding of the last one is large.
@example(
    rows=torch.tensor([[0.84, 0.98, 0.91], [0.67, 0.7, -0.13]], dtype=torch.float64),
    right=torch.zeros(1, 3).double(),
    factor=1.0,
)
@given(rows=vectors(2, within=1.0), right=vectors(1, within=1.0), factor=scales(decades=30))
def test_a_singular_matrix_is_told_and_stays_finite(
    rows: Tensor, right: Tensor, factor: float
) -> None:
    for rank in (0, 1, 2):
        some = rows[:rank] * factor**0.5
        matrix = (some.mT @ some).requires_grad_()
        b0, b1, b2 = right[0]
        solved, is_definite = solve3(packed(matrix), (b0, b1, b2))
        inverse = torch.stack(inverse3(packed(matrix)))
        assert not is_definite
        assert torch.stack(solved).isfinite().all() and inverse.isfinite().all()
        for values in (torch.stack(solved), inverse):
            gradient = torch.autograd.grad(values.sum(), matrix, retain_graph=True)[0]
            assert gradient.isfinite().all()
        # What is known of it is not lost: variances are not negative, and large somewhere.
        variances = inverse[[0, 3, 5]]
        trace = float(matrix.detach().diagonal().sum())
        assert (variances >= 0).all()
        if trace > 0:
            assert variances.max() > 0.01 / (16 * EPS * trace)


@given(rows=extreme(2, 3, decades=10), right=extreme(1, 3, decades=10))
def test_any_semidefinite_matrix_has_a_finite_solution_and_inverse(
    rows: Tensor, right: Tensor
) -> None:
    matrix = rows.mT @ rows
    b0, b1, b2 = right[0]
    solved, _ = solve3(packed(matrix), (b0, b1, b2))
    assert torch.stack(solved).isfinite().all()
    assert torch.stack(inverse3(packed(matrix))).isfinite().all()


def test_what_lies_just_beyond_rounding_is_definite() -> None:
    for small, wanted in ((100 * EPS, True), (8 * EPS, False)):
        diagonal = torch.tensor([1.0, 0.5, small]).double()
        zero, one = torch.zeros(()).double(), torch.ones(()).double()
        solved, is_definite = solve3(packed(torch.diag(diagonal)), (zero, zero, one))
        assert is_definite == wanted
        assert_close(solved[2], one / max(small, 16 * 1.5 * EPS), rtol=1e-6, atol=0)


def test_they_are_differentiable_twice() -> None:
    generator = torch.Generator().manual_seed(0)
    rows = torch.rand(2, 5, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    right = torch.rand(3, 2, generator=generator, dtype=torch.float64, requires_grad=True)

    def solve(rows: Tensor, right: Tensor) -> Tensor:
        b0, b1, b2 = right
        return torch.stack(solve3(packed(rows.mT @ rows), (b0, b1, b2))[0])

    def invert(rows: Tensor) -> Tensor:
        return torch.stack(inverse3(packed(rows.mT @ rows)))

    assert torch.autograd.gradcheck(solve, (rows, right), check_forward_ad=True)
    assert torch.autograd.gradgradcheck(solve, (rows, right))
    assert torch.autograd.gradcheck(invert, (rows,), check_forward_ad=True)


def test_batches_broadcast_cameras_against_points() -> None:
    generator = torch.Generator().manual_seed(0)
    proj = torch.randn(5, 1, 2, 3, 4, generator=generator).double()
    x, y, squared = torch.rand(3, 6, 2, 7, generator=generator).double()
    found = normal_matrix(normal_coefficients(proj), x, y, squared)
    assert all(entry.shape == (5, 6, 7) for entry in found)
    one = normal_matrix(normal_coefficients(proj[3, 0]), x[4], y[4], squared[4])
    for entry, wanted in zip(found, one, strict=True):
        assert_close(entry[3, 4], wanted)


@pytest.mark.parametrize("columns", [3, 4])
@pytest.mark.parametrize("count", [7, 1], ids=["weights of each point", "of all"])
def test_it_is_the_product_of_the_rows(columns: int, count: int) -> None:
    random = torch.Generator().manual_seed(5)
    proj = torch.randn(2, 3, 3, columns, generator=random, dtype=torch.float64)
    x, y = torch.randn(2, 2, 3, 7, generator=random, dtype=torch.float64)
    squared = torch.rand(2, 3, count, generator=random, dtype=torch.float64)
    if count == 1:
        found = torch.stack(normal_matrix(normal_coefficients(proj, squared), x, y), dim=-1)
    else:
        found = torch.stack(normal_matrix(normal_coefficients(proj), x, y, squared), dim=-1)
    pixels, weights = torch.stack([x, y], dim=-1), squared.sqrt().expand(2, 3, 7)
    equations = rows(proj[:, None], pixels.transpose(1, 2))
    stacked = (equations * weights.transpose(1, 2)[..., None, None]).flatten(-3, -2)
    row, column = torch.triu_indices(columns, columns)
    assert_close(found, (stacked.mT @ stacked)[..., row, column])
