"""The null vector of symmetric 4x4 matrices."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from deltas_geom.numerics.ldl import multiply
from deltas_geom.numerics.null_vector import NullVector, null_vector, proved_vector, rayleigh_step
from deltas_geom.numerics.vectors import Symmetric4, Vector4, dot, unit
from deltas_geom.testing.strategies import vectors

ROWS, COLUMNS = torch.triu_indices(4, 4)


def packed(matrix: Tensor) -> Symmetric4:
    m00, m01, m02, m03, m11, m12, m13, m22, m23, m33 = matrix[..., ROWS, COLUMNS].unbind(-1)
    return m00, m01, m02, m03, m11, m12, m13, m22, m23, m33


def found(matrix: Tensor) -> tuple[Tensor, NullVector]:
    """The vector of unit length with its derivatives, last coordinate not negative."""
    result = null_vector(packed(matrix))
    start = torch.stack(unit(result.vector), dim=-1)
    start = torch.where(start[..., 3:] < 0, -start, start)
    easy = torch.tensor([0, 0, 0, 1], dtype=start.dtype)
    start = torch.where(start.isfinite().all(dim=-1, keepdim=True), start, easy)
    step = rayleigh_step(packed(matrix), of(start))
    return torch.stack(unit(step), dim=-1), result


def of(vector: Tensor) -> Vector4:
    x0, x1, x2, x3 = vector.unbind(dim=-1)
    return x0, x1, x2, x3


@st.composite
def semidefinite(draw: st.DrawFn, noise: float = 0.0) -> tuple[Tensor, Tensor]:
    """A matrix of trace 1 with eigenvalues noise, and 0.1 to 0.6, and its null vector."""
    turned = torch.eye(4, dtype=torch.float64) * 2 + draw(vectors(4, within=0.45, size=4))
    basis, _ = torch.linalg.qr(turned)
    values = torch.tensor([0.1, 0.2, 0.3]) + draw(vectors(1, within=0.05))[0] + 0.1
    values = torch.cat([values, torch.tensor([noise])]).double()
    return (basis * values) @ basis.mT / values.sum(), basis[:, 3]


def test_any_common_shape_is_a_batch(dtype: torch.dtype) -> None:
    matrix = torch.diag(torch.tensor([0.3, 0.3, 0.4, 0.0], dtype=dtype)).expand(2, 5, 4, 4)
    vector, result = found(matrix)
    assert vector.shape == (2, 5, 4) and vector.dtype == dtype and result.simple.all()
    assert_close(vector[1, 2], torch.tensor([0.0, 0, 0, 1], dtype=dtype))


@given(drawn=semidefinite())
def test_the_null_vector_is_found(drawn: tuple[Tensor, Tensor]) -> None:
    matrix, wanted = drawn
    vector, result = found(matrix)
    assert result.simple and vector[3] >= 0
    assert_close(vector, wanted * wanted[3].sign(), rtol=0, atol=1e-13)


@given(drawn=semidefinite(noise=1e-3))
def test_with_noise_it_minimises_the_quadratic_form(drawn: tuple[Tensor, Tensor]) -> None:
    matrix, _ = drawn
    vector, _ = found(matrix)
    values, vectors_ = np.linalg.eigh(matrix.numpy())
    assert abs(float(vector.numpy() @ vectors_[:, 0])) > 1 - 1e-13
    assert abs(float(vector @ matrix @ vector) - values[0]) < 1e-15


def test_packed_products_are_products() -> None:
    matrix = torch.arange(16.0).reshape(4, 4)
    matrix = matrix + matrix.mT
    x = torch.tensor([1.0, -2, 3, 0.5])
    x0, x1, x2, x3 = x
    image = multiply(packed(matrix), (x0, x1, x2, x3))
    assert_close(torch.stack(image), matrix @ x)
    assert_close(dot((x0, x1, x2, x3), (x0, x1, x2, x3)), x @ x)


def test_first_and_second_derivatives_are_right() -> None:
    generator = torch.Generator().manual_seed(0)
    rows = torch.rand(5, 4, generator=generator, dtype=torch.float64)
    nearly_null = torch.tensor([0.1, -0.5, 0.5, 0.7]).double()
    rows = rows - 0.9 * torch.outer(rows @ nearly_null, nearly_null)

    def solve(rows: Tensor) -> Tensor:
        normal = rows.mT @ rows
        return found(normal / normal.diagonal().sum().detach())[0]

    assert torch.autograd.gradcheck(solve, (rows.requires_grad_(),))
    assert torch.autograd.gradgradcheck(solve, (rows,))


def test_equal_other_eigenvalues_leave_the_gradient_finite_where_eighs_is_nan() -> None:
    matrix = torch.diag(torch.tensor([0.25, 0.25, 0.5, 0.0])).double().requires_grad_()
    weights = torch.tensor([1.0, 2, 3, 4]).double()
    ours = torch.autograd.grad(found(matrix)[0] @ weights, matrix)[0]
    theirs = torch.autograd.grad(
        (torch.linalg.eigh(matrix).eigenvectors @ torch.ones(4).double()) @ weights, matrix
    )[0]
    assert ours.isfinite().all() and not theirs.isfinite().all()

    def solve(matrix: Tensor) -> Tensor:
        return found((matrix + matrix.mT) / 2)[0]

    assert torch.autograd.gradcheck(solve, (matrix,))


def test_a_vector_at_infinity_is_found() -> None:
    direction = torch.tensor([2.0, -1, 10, 0]).double() / 105**0.5
    matrix = (torch.eye(4).double() - torch.outer(direction, direction)) / 3
    vector, result = found(matrix)
    assert result.simple and vector[3].abs() < 1e-15
    assert_close((vector @ direction).abs(), torch.ones(()).double())


def test_a_vector_that_is_not_unique_is_told_and_stays_finite() -> None:
    for diagonal in ([1.0, 0, 0, 0], [0, 0, 0, 1.0], [0.5, 0.5, 0, 0], [0.0, 0, 0, 0]):
        matrix = torch.diag(torch.tensor(diagonal)).double().requires_grad_()
        vector, result = found(matrix)
        assert not result.simple and vector.isfinite().all()
        assert torch.autograd.grad(vector.sum(), matrix)[0].isfinite().all()


def test_gross_outliers_leave_the_smallest_eigenvalue_found() -> None:
    generator = torch.Generator().manual_seed(0)
    rows = torch.randn(2000, 4, 4, generator=generator, dtype=torch.float64)
    rows[..., 3] *= 0.1
    normal = rows.mT @ rows
    normal = normal / normal.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    vector, result = found(normal)
    smallest = torch.linalg.eigh(normal).eigenvectors[..., 0]
    wrong = (vector * smallest).sum(dim=-1).abs() < 0.999
    assert wrong.float().mean() < 0.01 and (wrong & result.simple).float().mean() < 0.005


def test_two_close_eigenvalues_are_told_apart() -> None:
    """A case in which the Rayleigh iteration leaves for the second eigenvector."""
    values = [
        719999.8266832755, 0.019752511222488778, -47535.232663905976, -190140.9957403675,
        720000.0138667404, 41686.843648556525, 166747.38940237265,
        5552.111347575692, 22207.7534054328, 88831.23117162606,
    ]  # fmt: skip
    matrix = torch.zeros(4, 4).double()
    matrix[ROWS, COLUMNS] = matrix[COLUMNS, ROWS] = torch.tensor(values).double()
    vector, result = found(matrix)
    smallest = torch.linalg.eigh(matrix).eigenvectors[:, 0]
    assert result.simple
    assert (vector @ smallest).abs() > 1 - 1e-9


def test_what_is_called_simple_is_the_smallest_eigenvector() -> None:
    generator = torch.Generator().manual_seed(1)
    basis, _ = torch.linalg.qr(torch.randn(5000, 4, 4, generator=generator, dtype=torch.float64))
    second = 1e-6 * (1 + 10 ** (-6 * torch.rand(5000, generator=generator).double()))
    values = torch.stack([torch.full_like(second, 1e-6), second, second * 3e5, second * 4e5], -1)
    matrix = (basis * values.unsqueeze(-2)) @ basis.mT
    vector, result = found(matrix / values.sum(dim=-1)[:, None, None])
    right = (vector * basis[..., 0]).sum(dim=-1).abs() > 0.999
    assert (result.simple & ~right).sum() == 0
    assert (result.simple & right).float().mean() > 0.9


def spread_eigenvalues(count: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """Matrices from easy to hopeless, and their smallest eigenvectors."""
    random = torch.Generator().manual_seed(2)
    basis, _ = torch.linalg.qr(torch.randn(count, 4, 4, generator=random, dtype=torch.float64))
    second = 10 ** (-8 * torch.rand(count, generator=random, dtype=torch.float64))
    smallest = second * 10 ** (-0.5 - 11 * torch.rand(count, generator=random, dtype=torch.float64))
    values = torch.stack([smallest, second, 0 * second + 1, 0 * second + 2], dim=-1)
    matrix = (basis * values.unsqueeze(-2)) @ basis.mT
    return (matrix / values.sum(dim=-1)[:, None, None]).to(dtype), basis[..., 0]


@pytest.mark.parametrize("accuracy", [1e-9, 1e-5])
def test_what_is_proved_is_as_accurate_as_said(accuracy: float) -> None:
    matrix, _ = spread_eigenvalues(20_000)
    vector, proved = proved_vector(packed(matrix), accuracy)
    exact, _ = null_vector(packed(matrix))
    found, wanted = torch.stack(unit(vector), dim=-1), torch.stack(unit(exact), dim=-1)
    error = (found - wanted * (found * wanted).sum(-1, keepdim=True).sign()).norm(dim=-1)
    assert 0.1 < proved.float().mean() < 0.9  # some are hard, or nothing is tested
    rounding = 64 * torch.finfo(matrix.dtype).eps / torch.linalg.eigvalsh(matrix)[:, 1]
    assert (error <= accuracy + rounding)[proved].all()


def test_easy_and_hard_ones_together_are_as_each_alone() -> None:
    matrix, smallest = spread_eigenvalues(500)
    matrix[7], matrix[11] = torch.nan, 0.0
    together = null_vector(packed(matrix.reshape(5, 100, 4, 4)), accuracy=1e-9)
    found = torch.stack(unit(together.vector), dim=-1)
    assert found.shape == (5, 100, 4) and together.simple.shape == (5, 100)
    assert not together.simple[0, [7, 11]].any() and together.simple.float().mean() > 0.9
    cosine = (found.reshape(500, 4) * smallest).sum(dim=-1).abs()
    assert cosine[together.simple.flatten()].min() > 1 - 1e-9
    for number in range(40):
        alone = null_vector(packed(matrix[number]), accuracy=1e-9)
        assert alone.simple == together.simple.flatten()[number]
        if alone.simple:
            wanted = torch.stack(unit(alone.vector), dim=-1)
            assert_close(found.reshape(500, 4)[number], wanted, rtol=0, atol=1e-15)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.8])
@pytest.mark.parametrize("views", [2, 5])
def test_polished_by_its_rows_the_vector_is_as_exact_as_an_svd_of_them(
    views: int, share: float
) -> None:
    # Of the two smallest singular values, 1e-5 and a share of it, the square keeps six digits.
    random = torch.Generator().manual_seed(3)
    drawn = torch.randn(2000, 2 * views, 4, generator=random, dtype=torch.float64)
    left, _, right = torch.linalg.svd(drawn, full_matrices=False)
    values = torch.tensor([1.0, 0.3, 1e-5, share * 1e-5], dtype=torch.float64)
    rows = (left * values) @ right
    smallest = torch.linalg.svd(rows).Vh[:, 3]

    def product(x: Vector4) -> Vector4:
        return of((rows.mT @ (rows @ torch.stack(x, dim=-1).unsqueeze(-1))).squeeze(-1))

    def error(vector: Vector4) -> Tensor:
        found = torch.stack(unit(vector), dim=-1)
        return (found - smallest * (found * smallest).sum(dim=-1, keepdim=True)).norm(dim=-1)

    polished, simple = null_vector(packed(rows.mT @ rows), product=product, polish=2)
    plain = null_vector(packed(rows.mT @ rows)).vector
    # The rounding of the rows turns the vector by so much, whoever computes it.
    rounding = torch.finfo(rows.dtype).eps / (1e-5 * (1 - share))
    # One start in a hundred ends at the wrong vector, and is told.
    assert simple.double().mean() > 0.98
    assert error(polished)[simple].max() <= 30 * rounding
    assert error(polished)[simple].median() <= rounding
    assert error(plain).median() >= 1000 * rounding


@pytest.mark.parametrize("num_views", [2, 8])
def test_good_matches_are_proved(num_views: int) -> None:
    random = torch.Generator().manual_seed(num_views)
    rays = torch.rand(500, 3, generator=random, dtype=torch.float64) + torch.tensor([0, 0, 20.0])
    centers = torch.zeros(num_views, 1, 3, dtype=torch.float64)
    centers[:, 0, 0] = torch.linspace(-1, 1, num_views)
    places = rays - centers
    image = places[..., :2] / places[..., 2:]
    image += 2e-3 * torch.randn(image.shape, generator=random, dtype=torch.float64)  # 1 px of 500
    pose = torch.cat([torch.eye(3).double().expand(num_views, 3, 3), -centers.mT], dim=-1)
    rows = image[..., None] * pose[:, None, 2:] - pose[:, None, :2]
    rows = rows.transpose(0, 1).flatten(1, 2)
    _, proved = proved_vector(packed(rows.mT @ rows), 1e-9)
    assert proved.float().mean() > 0.99
