"""Symmetric 3x3 matrices, semidefinite: their solves and inverses, by arithmetic alone.

Source: Golub and Van Loan, 4th ed., section 4.1.
"""

import torch
from torch import Tensor

from deltas_geom.numerics.ldl import Vector3

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
