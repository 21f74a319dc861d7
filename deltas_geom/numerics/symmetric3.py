"""Symmetric 3x3 matrices, semidefinite: their solves and inverses, by arithmetic alone.

Source: Golub and Van Loan, 4th ed., section 4.1.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from deltas_geom.numerics.arithmetic import outside_gradients
from deltas_geom.numerics.vectors import Symmetric3, Vector3, less, scaled


def _factor3(normal: Symmetric3) -> tuple[tuple[Tensor, ...], Tensor]:
    """LDL^T: inverse pivots and l10 l20 l21; is the matrix definite beyond rounding?

    A pivot below rounding counts as rounding. Rounding of the matrix changes the last pivot by as
    much as the last row of L^-1 is long, squared, so that it does not matter which axis comes last.
    """
    a00, a01, a02, a11, a12, a22 = normal
    with outside_gradients():
        least = 16 * torch.finfo(a00.dtype).eps * (a00 + a11 + a22)
        least = torch.where(least > 0, least, 1.0)

    def reciprocal(pivot: Tensor) -> tuple[Tensor, Tensor]:
        definite = pivot > least
        return 1 / torch.where(definite, pivot, least), definite

    i0, definite0 = reciprocal(a00)
    l10, l20 = a01 * i0, a02 * i0
    i1, definite1 = reciprocal(less(a11, l10, a01))
    t21 = less(a12, l20, a01)
    l21 = t21 * i1
    d2 = less(less(a22, l20, a02), l21, t21)
    i2, _ = reciprocal(d2)
    with outside_gradients():
        n20 = less(l20, l10, l21)
        definite2 = d2 > least * (1 + l21.square() + n20.square())
    return (i0, i1, i2, l10, l20, l21), definite0 & definite1 & definite2


def substituted3(factors: Sequence[Tensor], right: Vector3) -> Vector3:
    """Solutions by LDL^T: inverse pivots and l10 l20 l21."""
    (i0, i1, i2, l10, l20, l21), (b0, b1, b2) = factors, right
    b1 = less(b1, l10, b0)
    z2 = less(less(b2, l20, b0), l21, b1) * i2
    z1 = less(b1 * i1, l21, z2)
    return less(less(b0 * i0, l10, z1), l20, z2), z1, z2


def solve3(normal: Symmetric3, right: Vector3) -> tuple[Vector3, Tensor]:
    """Solve semidefinite 3x3 systems; is each matrix definite beyond rounding?"""
    factors, definite = _factor3(normal)
    return substituted3(factors, right), definite


def solve3_scaled(normal: Symmetric3, right: Vector3) -> tuple[Vector3, Tensor]:
    """:func:`solve3` of any finite matrices; finite, with finite gradients, if not definite.

    A matrix whose trace is so large or small that squares of it leave the range of numbers
    counts as not definite.
    """
    with outside_gradients():
        trace = normal[0] + normal[3] + normal[5]
        largest = torch.finfo(trace.dtype).max ** 0.45
        ordinary = (trace > 1 / largest) & (trace < largest)
        share = torch.where(ordinary, trace.reciprocal(), trace.new_zeros(()))
    return solve3(scaled(normal, share), scaled(right, share))


def inverse3(normal: Symmetric3) -> Symmetric3:
    """Inverses of semidefinite 3x3 matrices.

    What is singular within rounding is inverted as if it were just beyond: large, not infinite.
    """
    (i0, i1, i2, l10, l20, l21), _ = _factor3(normal)
    n20 = torch.addcmul(-l20, l10, l21)
    c12, c02, c01 = -l21 * i2, n20 * i2, -l10 * i1
    c11 = less(i1, l21, c12)
    c00 = less(torch.addcmul(i0, n20, c02), l10, c01)
    c01 = torch.addcmul(c01, n20, c12)
    return c00, c01, c02, c11, c12, i2
