"""The null vector of symmetric 4x4 matrices, by arithmetic alone.

A batch of matrices is a struct of arrays: ten tensors of any common shape, the upper triangle
row by row. Elementwise arithmetic over the batch is an order of magnitude faster than a
batched SVD, never raises and compiles. The route is LDL with the last coordinate eliminated
last (robust to the world's unit and origin), one inverse iteration and one Rayleigh quotient
iteration; gradients come from one more Rayleigh step, solved in the complement of the vector,
where they stay finite when other eigenvalues meet (there SVD's are NaN). Where the vector
itself is not unique, no division by a vanishing pivot happens and the caller is told.

Source: Golub and Van Loan, 4th ed., sections 4.1 and 8.2; the step is cubically convergent,
so its first and second derivatives at the solution are exact.
"""

from typing import NamedTuple

import torch
from torch import Tensor

Symmetric4 = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]
"""m00 m01 m02 m03 m11 m12 m13 m22 m23 m33."""
Vector4 = tuple[Tensor, Tensor, Tensor, Tensor]


class NullVector(NamedTuple):
    """A null vector and whether it is one.

    Attributes:
        vector: unit, differentiable; the last coordinate is not negative. Finite wherever the
            matrix is.
        simple: bool; False where the smallest eigenvalue is not apart from the others by more
            than rounding (the vector is then arbitrary).
    """

    vector: Vector4
    simple: Tensor


def null_vector(matrix: Symmetric4) -> NullVector:
    """Unit vector x that minimises x^T M x, differentiable in M.

    Args:
        matrix: positive semidefinite, finite, trace about 1.
    """
    with torch.no_grad():
        near = _inverse_iteration(matrix)
        nearer = _rayleigh(matrix, near)
        # Rayleigh iteration may leave for the next eigenvector, where the quotient is larger.
        better = dot(nearer, multiply(matrix, nearer)) <= dot(near, multiply(matrix, near))
        x0, x1, x2, x3 = (torch.where(better, b, a) for a, b in zip(near, nearer, strict=True))
        start = (x0, x1, x2, x3)
        converged = dot(start, start).isfinite()
        x0, x1, x2, x3 = (torch.where(converged, component, 0.0) for component in start)
        start = (x0, x1, x2, torch.where(converged, x3, 1.0))
    step, definite = _rayleigh_step(matrix, start)
    sign = torch.where(step[3] < 0, -1.0, 1.0).to(step[3].dtype)
    vector = (step[0] * sign, step[1] * sign, step[2] * sign, step[3] * sign)
    return NullVector(vector, converged & definite)


def multiply(matrix: Symmetric4, x: Vector4) -> Vector4:
    """M x."""
    m00, m01, m02, m03, m11, m12, m13, m22, m23, m33 = matrix
    return (
        dot((m00, m01, m02, m03), x),
        dot((m01, m11, m12, m13), x),
        dot((m02, m12, m22, m23), x),
        dot((m03, m13, m23, m33), x),
    )


def dot(a: Vector4, b: Vector4) -> Tensor:
    """a · b."""
    total = a[0] * b[0]
    for i in range(1, 4):
        total = torch.addcmul(total, a[i], b[i])
    return total


def _less(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """a - b c in one pass over memory, which is what this file costs."""
    return torch.addcmul(a, b, c, value=-1)


def _unit(x: Vector4) -> Vector4:
    scale = torch.rsqrt(dot(x, x))
    return (x[0] * scale, x[1] * scale, x[2] * scale, x[3] * scale)


_INVERSE_ITERATIONS = 3
_Factors = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]


def _factor(matrix: Symmetric4) -> _Factors:
    """LDL^T: inverse pivots 0..2, the last pivot, and l10 l20 l30 l21 l31 l32."""
    m00, m01, m02, m03, m11, m12, m13, m22, m23, m33 = matrix
    i0 = 1 / _nudged(m00)
    l10, l20, l30 = m01 * i0, m02 * i0, m03 * i0
    i1 = 1 / _nudged(_less(m11, l10, m01))
    t21, t31 = _less(m12, l20, m01), _less(m13, l30, m01)
    l21, l31 = t21 * i1, t31 * i1
    i2 = 1 / _nudged(_less(_less(m22, l20, m02), l21, t21))
    t32 = _less(_less(m23, l30, m02), l31, t21)
    l32 = t32 * i2
    d3 = _less(_less(_less(m33, l30, m03), l31, t31), l32, t32)
    return i0, i1, i2, d3, l10, l20, l30, l21, l31, l32


def _nudged(pivot: Tensor) -> Tensor:
    """The pivot, moved off zero by rounding: inverse iteration then still finds the vector."""
    return torch.where(pivot == 0, torch.finfo(pivot.dtype).eps, pivot)


def _solve_scaled(factors: _Factors, b: Vector4) -> Vector4:
    """The last pivot times M^-1 b: the pivot that vanishes is never divided by."""
    i0, i1, i2, d3, l10, l20, l30, l21, l31, l32 = factors
    b0, b1, b2, b3 = b
    b1 = _less(b1, l10, b0)
    b2 = _less(_less(b2, l20, b0), l21, b1)
    z3 = _less(_less(_less(b3, l30, b0), l31, b1), l32, b2)
    z2 = _less(b2 * (i2 * d3), l32, z3)
    z1 = _less(_less(b1 * (i1 * d3), l21, z2), l31, z3)
    z0 = _less(_less(_less(b0 * (i0 * d3), l10, z1), l20, z2), l30, z3)
    return z0, z1, z2, z3


def _inverse_iteration(matrix: Symmetric4) -> Vector4:
    factors = _factor(matrix)
    _, _, _, _, l10, l20, l30, l21, l31, l32 = factors
    # M^-1 e4 up to scale is the inhomogeneous solution, a start that is nearly right.
    z2 = -l32
    z1 = -l31 - l21 * z2
    z0 = -l30 - l10 * z1 - l20 * z2
    x0, x1, x2, x3 = _unit((z0, z1, z2, torch.ones_like(z0)))
    # The nudge reaches vectors near infinity, to which e4 is nearly or exactly orthogonal.
    x = (x0 + 0.13, x1 + 0.07, x2 + 0.11, x3)
    # Once is enough for good matches; gross outliers bring the next eigenvalue near.
    for _ in range(_INVERSE_ITERATIONS):
        x = _unit(_solve_scaled(factors, x))
    return x


def _rayleigh(matrix: Symmetric4, x: Vector4) -> Vector4:
    """One Rayleigh quotient iteration."""
    m00, m01, m02, m03, m11, m12, m13, m22, m23, m33 = matrix
    shift = dot(x, multiply(matrix, x))
    shifted = (m00 - shift, m01, m02, m03, m11 - shift, m12, m13, m22 - shift, m23, m33 - shift)
    return _unit(_solve_scaled(_factor(shifted), x))


def _rayleigh_step(matrix: Symmetric4, x: Vector4) -> tuple[Vector4, Tensor]:
    """x - (M - mu)^+ (M x), mu = x^T M x: what autograd differentiates; and whether it may."""
    image = multiply(matrix, x)
    change, definite = _solve_in_complement(matrix, x, dot(x, image), image)
    step = _unit((x[0] - change[0], x[1] - change[1], x[2] - change[2], x[3] - change[3]))
    return step, definite


def _solve_in_complement(
    matrix: Symmetric4, x: Vector4, mu: Tensor, g: Vector4
) -> tuple[Vector4, Tensor]:
    """(M - mu)^+ g in the 3-space orthogonal to the unit vector x; is M - mu definite there?

    A Householder reflection takes x to the last axis; what is left is a definite 3x3 system.
    Where it is not, 0 is returned, with no gradient.
    """
    m00, m01, m02, _, m11, m12, _, m22, _, _ = matrix
    x0, x1, x2, x3 = x
    sign = torch.where(x3 < 0, -1.0, 1.0).to(x3.dtype)
    beta = 1 / (1 + x3 * sign)
    u = (x0, x1, x2, x3 + sign)
    image = multiply(matrix, u)
    half = beta * beta * 0.5 * dot(u, image)
    q0, q1, q2 = (beta * image[i] - half * u[i] for i in range(3))
    a00 = m00 - 2 * x0 * q0 - mu
    a01 = m01 - x0 * q1 - q0 * x1
    a02 = m02 - x0 * q2 - q0 * x2
    a11 = m11 - 2 * x1 * q1 - mu
    a12 = m12 - x1 * q2 - q1 * x2
    a22 = m22 - 2 * x2 * q2 - mu
    reflect = beta * dot(u, g)
    h0, h1, h2 = g[0] - reflect * x0, g[1] - reflect * x1, g[2] - reflect * x2

    # Rounding of the entries, whose trace is about 1, reaches the pivots.
    noise = 64 * torch.finfo(mu.dtype).eps
    i0, definite0 = _reciprocal(a00, noise)
    l10, l20 = a01 * i0, a02 * i0
    i1, definite1 = _reciprocal(a11 - l10 * a01, noise)
    t = a12 - l20 * a01
    l21 = t * i1
    i2, definite2 = _reciprocal(a22 - l20 * a02 - l21 * t, noise)
    definite = definite0 & definite1 & definite2
    h1 = h1 - l10 * h0
    h2 = (h2 - l20 * h0 - l21 * h1) * i2
    h1 = h1 * i1 - l21 * h2
    h0 = h0 * i0 - l10 * h1 - l20 * h2

    reflect = beta * (x0 * h0 + x1 * h1 + x2 * h2)
    solution = (h0 - reflect * u[0], h1 - reflect * u[1], h2 - reflect * u[2], -reflect * u[3])
    s0, s1, s2, s3 = (torch.where(definite, component, 0.0) for component in solution)
    return (s0, s1, s2, s3), definite


def _reciprocal(pivot: Tensor, noise: float) -> tuple[Tensor, Tensor]:
    """1 / pivot, and whether it is positive beyond rounding; elsewhere 1, with no gradient."""
    positive = pivot > noise
    return 1 / torch.where(positive, pivot, 1.0), positive
