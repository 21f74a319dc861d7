"""Normal matrices of the equations that pixels put to points, and their small solves.

A pixel (x, y) of a camera with the rows p1, p2, p3 puts two equations to a point X:
(x p3 - p1) X = 0 and (y p3 - p2) X = 0. Every entry of their squares is linear in
(x^2 + y^2, x, y, 1), so all points together cost one matrix product.

Source: Hartley and Zisserman, 2nd ed., section 12.2.
"""

import torch
from torch import Tensor

from deltas_geom.triangulation.observed import Vector3, over_views


def normal_matrix(proj: Tensor, x: Tensor, y: Tensor, squared: Tensor) -> tuple[Tensor, ...]:
    """A^T W^2 A of the weighted equations, upper triangle row by row.

    Args:
        proj: ``(*B, V, 3, K)`` rows p1, p2, p3, of K = 4 (homogeneous points) or 3 entries.
        x: ``(*B, V, N)`` px.
        y: ``(*B, V, N)`` px.
        squared: ``(*B, V, N)``, or of one point for all, squared weights of the equations.

    Returns:
        K (K + 1) / 2 entries ``(*B, N)``.
    """
    if torch.compiler.is_compiling():
        return _by_views(proj, x, y, squared)
    across, down = x * squared, y * squared
    square = torch.addcmul(x * across, y, down)
    terms = torch.stack([square, across, down, squared.expand_as(across)], dim=-2)
    return over_views(_coefficients(proj).flatten(-3, -2).mT, terms.flatten(-3, -2))


def _by_views(proj: Tensor, x: Tensor, y: Tensor, squared: Tensor) -> tuple[Tensor, ...]:
    """The same without a product of matrices, so that a compiler fuses it with what follows."""
    entries = [torch.zeros_like(x[..., 0, :])] * (proj.shape[-1] * (proj.shape[-1] + 1) // 2)
    for view, coefficients in enumerate(_coefficients(proj).unbind(dim=-3)):
        weight, along, down = (part[..., view, :] for part in (squared, x, y))
        square = along * along + down * down
        for n, column in enumerate(coefficients.unbind(dim=-1)):
            a, b, c, d = (factor.unsqueeze(-1) for factor in column.unbind(dim=-1))
            entries[n] = entries[n] + weight * (a * square + b * along + c * down + d)
    return tuple(entries)


def _coefficients(proj: Tensor) -> Tensor:
    """``(*B, V, 4, K (K + 1) / 2)`` of x^2 + y^2, x, y and 1."""
    p1, p2, p3 = proj.unbind(dim=-2)
    first, second = _outer(p3, p1), _outer(p3, p2)
    squares = torch.stack(
        [
            _outer(p3, p3),
            -(first + first.mT),
            -(second + second.mT),
            _outer(p1, p1) + _outer(p2, p2),
        ],
        dim=-3,
    )  # (*B, V, 4, K, K)
    return torch.cat([squares[..., row, row:] for row in range(proj.shape[-1])], dim=-1)


def alike_coefficients(proj: Tensor, squared: Tensor) -> Tensor:
    """What :func:`alike_normal_matrix` needs of cameras, once for all points.

    Args:
        proj: see :func:`normal_matrix`.
        squared: ``(*B, V, 1)`` squared weights, those of all points.
    """
    square, x, y, one = (_coefficients(proj) * squared.unsqueeze(-1)).unbind(dim=-2)
    pixels = torch.stack([x, y], dim=-2).flatten(-3, -2)
    return torch.cat([pixels, square, one.sum(dim=-2, keepdim=True)], dim=-2).mT


def alike_normal_matrix(coefficients: Tensor, xy: Tensor) -> tuple[Tensor, ...]:
    """:func:`normal_matrix` of pixels ``(*B, V, 2, N)`` that all weigh the same."""
    x, y = xy.unbind(dim=-2)
    square = torch.addcmul(x * x, y, y)
    one = torch.ones_like(square[..., :1, :])
    return over_views(coefficients, torch.cat([xy.flatten(-3, -2), square, one], dim=-2))


def _outer(a: Tensor, b: Tensor) -> Tensor:
    return a.unsqueeze(-1) * b.unsqueeze(-2)


Symmetric3 = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]
"""m00 m01 m02 m11 m12 m22."""
_Factors3 = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]


def _factor3(normal: Symmetric3) -> tuple[_Factors3, Tensor]:
    """LDL^T: inverse pivots and l10 l20 l21; is the matrix definite beyond rounding?

    A pivot below rounding counts as rounding.
    """
    a00, a01, a02, a11, a12, a22 = normal
    with torch.no_grad():
        least = 16 * torch.finfo(a00.dtype).eps * (a00 + a11 + a22)
        least = torch.where(least > 0, least, 1.0)

    def reciprocal(pivot: Tensor) -> tuple[Tensor, Tensor]:
        definite = pivot > least
        return 1 / torch.where(definite, pivot, least), definite

    i0, definite0 = reciprocal(a00)
    l10, l20 = a01 * i0, a02 * i0
    i1, definite1 = reciprocal(torch.addcmul(a11, l10, a01, value=-1))
    t21 = torch.addcmul(a12, l20, a01, value=-1)
    l21 = t21 * i1
    d2 = torch.addcmul(torch.addcmul(a22, l20, a02, value=-1), l21, t21, value=-1)
    i2, definite2 = reciprocal(d2)
    return (i0, i1, i2, l10, l20, l21), definite0 & definite1 & definite2


def solve3(normal: Symmetric3, right: Vector3) -> tuple[Vector3, Tensor]:
    """Solve semidefinite 3x3 systems; is each matrix definite beyond rounding?"""
    (i0, i1, i2, l10, l20, l21), definite = _factor3(normal)
    b0, b1, b2 = right
    b1 = torch.addcmul(b1, l10, b0, value=-1)
    b2 = torch.addcmul(torch.addcmul(b2, l20, b0, value=-1), l21, b1, value=-1)
    z2 = b2 * i2
    z1 = torch.addcmul(b1 * i1, l21, z2, value=-1)
    z0 = torch.addcmul(torch.addcmul(b0 * i0, l10, z1, value=-1), l20, z2, value=-1)
    return (z0, z1, z2), definite


def solve3_scaled(normal: Symmetric3, right: Vector3) -> tuple[Vector3, Tensor]:
    """:func:`solve3` of any finite matrices; finite, with finite gradients, if not definite.

    A matrix whose trace is so large or small that squares of it leave the range of numbers
    counts as not definite.
    """
    with torch.no_grad():
        trace = normal[0] + normal[3] + normal[5]
        largest = torch.finfo(trace.dtype).max ** 0.45
        ordinary = (trace > 1 / largest) & (trace < largest)
        share = torch.where(ordinary, trace.reciprocal(), trace.new_zeros(()))
    m00, m01, m02, m11, m12, m22 = (entry * share for entry in normal)
    r0, r1, r2 = (entry * share for entry in right)
    return solve3((m00, m01, m02, m11, m12, m22), (r0, r1, r2))


def second_derivative(
    normal: Symmetric3,
    proj: Tensor,
    place: tuple[Tensor, Tensor],
    offset: tuple[Tensor, Tensor],
    inverse: Tensor,
    influence: Tensor,
    bend: Tensor,
) -> Symmetric3:
    """Second derivative by points of half the sum of w^2 rho(e^2), e the reprojection errors.

    Args:
        normal: J^T W^2 J with the weights w^2 rho', six ``(*B, N)``.
        proj: ``(*B, V, 3, 4)``.
        place: x and y ``(*B, V, N)`` px of the projected points.
        offset: x and y ``(*B, V, N)`` px of the errors.
        inverse: ``(*B, V, N)`` 1 / depth.
        influence: ``(*B, V, N)`` w^2 rho'.
        bend: ``(*B, V, N)`` 2 w^2 rho''.

    Source: Triggs et al., Bundle Adjustment: A Modern Synthesis (2000), section 4.3.
    """
    (x, y), (dx, dy) = place, offset
    p1, p2, p3 = proj[..., :3].unsqueeze(-2).unbind(dim=-3)  # (*B, V, 1, 3)
    along = dx * x + dy * y
    # J^T e of each view. A change of the point changes J by -(J p3^T + p3 J^T) / depth.
    slope = [(dx * p1[..., i] + dy * p2[..., i] - along * p3[..., i]) * inverse for i in range(3)]
    turn = [influence * inverse * p3[..., i] for i in range(3)]

    def entry(i: int, j: int) -> Tensor:
        bent = bend * slope[i] * slope[j] - turn[i] * slope[j] - turn[j] * slope[i]
        return bent.sum(dim=-2)

    m00, m01, m02, m11, m12, m22 = normal
    return (
        m00 + entry(0, 0), m01 + entry(0, 1), m02 + entry(0, 2),
        m11 + entry(1, 1), m12 + entry(1, 2), m22 + entry(2, 2),
    )  # fmt: skip


def inverse3(normal: Symmetric3) -> Symmetric3:
    """Inverses of semidefinite 3x3 matrices.

    What is singular within rounding is inverted as if it were just beyond: large, not infinite.
    """
    (i0, i1, i2, l10, l20, l21), _ = _factor3(normal)
    n20 = torch.addcmul(-l20, l10, l21)
    c12, c02, c01 = -l21 * i2, n20 * i2, -l10 * i1
    c11 = torch.addcmul(i1, l21, c12, value=-1)
    c00 = torch.addcmul(torch.addcmul(i0, n20, c02), l10, c01, value=-1)
    c01 = torch.addcmul(c01, n20, c12)
    return c00, c01, c02, c11, c12, i2
