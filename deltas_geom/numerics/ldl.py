"""Symmetric 4x4 matrices and their LDL^T, by arithmetic alone.

Source: Golub and Van Loan, 4th ed., sections 4.1 and 5.2.8.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.numerics.symmetric3 import substituted3
from deltas_geom.numerics.vectors import Symmetric4, Vector3, Vector4, dot, less, scaled


def trace_of(matrix: Symmetric4) -> Tensor:
    """The sum of the diagonal."""
    return matrix[0] + matrix[4] + matrix[7] + matrix[9]


def rounding(trace: Tensor) -> Tensor:
    """What rounding of a matrix's entries may do to an eigenvalue, from its trace."""
    return (64 * torch.finfo(trace.dtype).eps) * trace


def multiply(matrix: Symmetric4, x: Vector4) -> Vector4:
    """M x."""
    m00, m01, m02, m03, m11, m12, m13, m22, m23, m33 = matrix
    return (
        dot((m00, m01, m02, m03), x),
        dot((m01, m11, m12, m13), x),
        dot((m02, m12, m22, m23), x),
        dot((m03, m13, m23, m33), x),
    )


def shifted(matrix: Symmetric4, shift: Tensor) -> Symmetric4:
    """M - shift."""
    m00, m01, m02, m03, m11, m12, m13, m22, m23, m33 = matrix
    return m00 - shift, m01, m02, m03, m11 - shift, m12, m13, m22 - shift, m23, m33 - shift


class Pivots(NamedTuple):
    """LDL^T, unit lower triangular L.

    Attributes:
        i0, i1, i2: inverse pivots.
        d3: the last pivot, which may vanish.
        l10, l20, l30, l21, l31, l32: row 1, column 0 of L, and so on.
    """

    i0: Tensor
    i1: Tensor
    i2: Tensor
    d3: Tensor
    l10: Tensor
    l20: Tensor
    l30: Tensor
    l21: Tensor
    l31: Tensor
    l32: Tensor


class Factors(NamedTuple):
    """LDL^T, and to solve with it the last pivot by each of the others."""

    pivots: Pivots
    scales: Vector3


def eliminate(matrix: Symmetric4) -> Pivots:
    """LDL^T of matrices, the last coordinate eliminated last."""
    m00, m01, m02, m03, m11, m12, m13, m22, m23, m33 = matrix
    i0 = m00.reciprocal()
    l10, l20, l30 = m01 * i0, m02 * i0, m03 * i0
    i1 = less(m11, l10, m01).reciprocal()
    t21, t31 = less(m12, l20, m01), less(m13, l30, m01)
    l21, l31 = t21 * i1, t31 * i1
    i2 = less(less(m22, l20, m02), l21, t21).reciprocal()
    t32 = less(less(m23, l30, m02), l31, t21)
    l32 = t32 * i2
    d3 = less(less(less(m33, l30, m03), l31, t31), l32, t32)
    return Pivots(i0, i1, i2, d3, l10, l20, l30, l21, l31, l32)


def factor(matrix: Symmetric4) -> Factors:
    """The same, to solve with."""
    pivots = eliminate(matrix)
    return Factors(pivots, scaled(pivots[:3], pivots.d3))


def solve_leading(f: Pivots, b: Vector3) -> Vector3:
    """A^-1 b, A the leading 3x3 block."""
    return substituted3((f.i0, f.i1, f.i2, f.l10, f.l20, f.l21), b)


def solve_scaled(factors: Factors, b: Vector4) -> Vector4:
    """The last pivot times M^-1 b: the pivot that vanishes is never divided by."""
    f, (s0, s1, s2) = factors
    b0, b1, b2, b3 = b
    b1 = less(b1, f.l10, b0)
    b2 = less(less(b2, f.l20, b0), f.l21, b1)
    b3 = less(less(less(b3, f.l30, b0), f.l31, b1), f.l32, b2)
    return _back(f, b0 * s0, b1 * s1, b2 * s2, b3)


def start(factors: Factors) -> Vector4:
    """The same for a b of which L^-1 b is constant: nearly M^-1 e4, the inhomogeneous solution.

    The other components reach vectors near infinity, to which e4 is nearly orthogonal.
    """
    f, (s0, s1, s2) = factors
    return _back(f, 0.13 * s0, 0.07 * s1, 0.11 * s2, torch.ones_like(f.d3))


def _back(f: Pivots, z0: Tensor, z1: Tensor, z2: Tensor, z3: Tensor) -> Vector4:
    z2 = less(z2, f.l32, z3)
    z1 = less(less(z1, f.l21, z2), f.l31, z3)
    z0 = less(less(less(z0, f.l10, z1), f.l20, z2), f.l30, z3)
    return z0, z1, z2, z3
