"""The null vector of symmetric 4x4 matrices, by arithmetic alone.

A batch of matrices is a struct of arrays: ten tensors of any common shape, the upper triangle
row by row. Elementwise arithmetic over the batch is an order of magnitude faster than a
batched SVD, never raises and compiles. The route is LDL with the last coordinate eliminated
last (robust to the world's unit and origin), inverse iterations and one Rayleigh quotient
iteration. Gradients come from one more Rayleigh step, solved in the complement of the vector,
where they stay finite when other eigenvalues meet (there SVD's are NaN).

Source: Golub and Van Loan, 4th ed., sections 4.1, 8.1.4 (inertia) and 8.2; the step is cubically
convergent, so its first and second derivatives at the solution are exact.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

Symmetric4 = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]
"""m00 m01 m02 m03 m11 m12 m13 m22 m23 m33."""
Vector4 = tuple[Tensor, Tensor, Tensor, Tensor]

_INVERSE_ITERATIONS = 3  # one is enough for good matches; gross outliers bring eigenvalues near


class NullVector(NamedTuple):
    """A null vector and whether it is one.

    Attributes:
        vector: of any length and sign, without gradient. Not finite at worst where not simple.
        simple: bool; False where the smallest eigenvalue is not apart from the others by more
            than rounding (the vector is then arbitrary), or the matrix is not finite.
    """

    vector: Vector4
    simple: Tensor


@torch.no_grad()
def null_vector(
    matrix: Symmetric4,
    *,
    product: Callable[[Vector4], Vector4] | None = None,
    polish: int = 0,
) -> NullVector:
    """Vector x that minimises x^T M x / x^T x.

    Args:
        matrix: positive semidefinite.
        product: M x, computed more exactly than from M: for M = A^T A, A^T (A x).
        polish: corrections by ``product``, each of which takes the vector from the accuracy that
            M allows nearer to that of A.
    """
    noise = rounding(matrix)
    # Above the null space by the rounding of M, every pivot is positive.
    factors = _factor(_shifted(matrix, -noise))
    x = _start(factors)
    for _ in range(_INVERSE_ITERATIONS - 1):
        x = _solve_scaled(factors, x)
    x = unit(x)  # before it overflows: towards infinity each solve makes it longer
    near = _solve_scaled(factors, x)
    length = dot(near, near)
    quotient = factors.d3 * dot(near, x) / length - noise
    near, quotient = _nearer(matrix, _scaled(near, length.rsqrt()), quotient, noise)

    # Just above one eigenvalue, one pivot is negative (Sylvester's law of inertia).
    factors = _factor(_shifted(matrix, quotient + noise))
    signs = factors.i0.sign() + factors.i1.sign() + factors.i2.sign() + factors.d3.sign()
    simple = signs == 2
    vector = _solve_scaled(factors, near)
    if product is not None:
        for _ in range(polish):
            vector = _polished(factors, unit(vector), product)
    return NullVector(vector, simple)


def _nearer(
    matrix: Symmetric4, a: Vector4, quotient: Tensor, noise: Tensor
) -> tuple[Vector4, Tensor]:
    """A Rayleigh quotient iteration, and the smallest of what it and its start span.

    Between two close eigenvalues the iteration alone may stay where it is, or leave for the
    larger one; in the plane of both (Rayleigh-Ritz) the smaller one is found.

    Args:
        matrix: M.
        a: unit vector near the one looked for.
        quotient: a^T M a.
        noise: rounding of an eigenvalue.

    Returns:
        The vector, of any length, and its quotient.
    """
    # Off the quotient itself, where a pivot of a simple matrix may vanish exactly.
    below = -0.4 * noise
    factors = _factor(_shifted(matrix, quotient - below))
    b = _solve_scaled(factors, a)  # K b = d3 a with K = M - shift, and a^T K a = below
    along, length = dot(a, b), dot(b, b)
    across = torch.addcmul(length, along, along, value=-1)
    # K in the plane, times across: below * across, g * sqrt(across), -along * g.
    g = _less(factors.d3, below, along)
    half = 0.5 * torch.addcmul(below * across, along, g)
    step = half + torch.addcmul(half * half, g * g, across).clamp(min=0).sqrt()
    # Where both are one, or both quotients, within rounding, the iteration has converged.
    flat = (across <= 256 * torch.finfo(length.dtype).eps * length) | (g.abs() <= noise)
    zero, one = noise.new_zeros(()), noise.new_ones(())
    of_a = torch.where(flat, zero, torch.addcmul(g * across, step, along))
    of_b = torch.where(flat, one, -step)
    x0, x1, x2, x3 = (torch.addcmul(of_a * p, of_b, q) for p, q in zip(a, b, strict=True))
    change = torch.where(flat, below - factors.d3 * along / length, step / across)
    return (x0, x1, x2, x3), quotient - change


def _polished(f: "_Factors", x: Vector4, product: Callable[[Vector4], Vector4]) -> Vector4:
    """x - (M - mu)^+ (M x - mu x), mu = x^T M x: Newton's method in the complement of x."""
    image = product(x)
    mu = dot(x, image)
    g0, g1, g2, g3 = (_less(image[i], mu, x[i]) for i in range(4))
    inverse = f.d3.reciprocal()
    scaled = _solve_scaled(f, (g0, g1, g2, g3))
    # What the solve amplifies is along x, and goes.
    along = dot(x, scaled)
    x0, x1, x2, x3 = (_less(x[i], inverse, _less(scaled[i], along, x[i])) for i in range(4))
    return x0, x1, x2, x3


def rayleigh_step(matrix: Symmetric4, x: Vector4) -> Vector4:
    """x - (M - mu)^+ (M x), mu = x^T M x: the null vector with its derivatives.

    Args:
        matrix: positive semidefinite, finite.
        x: its null vector, of unit length and without gradient.

    Returns:
        Of about unit length. Where M - mu is not definite in the complement of x, x itself.
    """
    image = multiply(matrix, x)
    change = _solve_in_complement(matrix, x, dot(x, image), image)
    return x[0] - change[0], x[1] - change[1], x[2] - change[2], x[3] - change[3]


def rounding(matrix: Symmetric4) -> Tensor:
    """What rounding of the entries may do to an eigenvalue; without gradient."""
    m00, _, _, _, m11, _, _, m22, _, m33 = (entry.detach() for entry in matrix)
    return (64 * torch.finfo(m00.dtype).eps) * (m00 + m11 + m22 + m33)


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


def unit(x: Vector4) -> Vector4:
    """x / |x|."""
    return _scaled(x, dot(x, x).rsqrt())


def _scaled(x: Vector4, scale: Tensor) -> Vector4:
    return x[0] * scale, x[1] * scale, x[2] * scale, x[3] * scale


def _less(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """a - b c in one pass over memory, which is what this file costs."""
    return torch.addcmul(a, b, c, value=-1)


def _shifted(matrix: Symmetric4, shift: Tensor) -> Symmetric4:
    """M - shift."""
    m00, m01, m02, m03, m11, m12, m13, m22, m23, m33 = matrix
    return m00 - shift, m01, m02, m03, m11 - shift, m12, m13, m22 - shift, m23, m33 - shift


class _Factors(NamedTuple):
    """LDL^T, unit lower triangular L.

    Attributes:
        i0: inverse pivot 0, and so on.
        i1: ...
        i2: ...
        d3: the last pivot, which may vanish.
        s0: the last pivot by pivot 0, and so on.
        s1: ...
        s2: ...
        l10: row 1, column 0 of L, and so on.
        l20: ...
        l30: ...
        l21: ...
        l31: ...
        l32: ...
    """

    i0: Tensor
    i1: Tensor
    i2: Tensor
    d3: Tensor
    s0: Tensor
    s1: Tensor
    s2: Tensor
    l10: Tensor
    l20: Tensor
    l30: Tensor
    l21: Tensor
    l31: Tensor
    l32: Tensor


def _factor(matrix: Symmetric4) -> _Factors:
    m00, m01, m02, m03, m11, m12, m13, m22, m23, m33 = matrix
    i0 = m00.reciprocal()
    l10, l20, l30 = m01 * i0, m02 * i0, m03 * i0
    i1 = _less(m11, l10, m01).reciprocal()
    t21, t31 = _less(m12, l20, m01), _less(m13, l30, m01)
    l21, l31 = t21 * i1, t31 * i1
    i2 = _less(_less(m22, l20, m02), l21, t21).reciprocal()
    t32 = _less(_less(m23, l30, m02), l31, t21)
    l32 = t32 * i2
    d3 = _less(_less(_less(m33, l30, m03), l31, t31), l32, t32)
    return _Factors(i0, i1, i2, d3, i0 * d3, i1 * d3, i2 * d3, l10, l20, l30, l21, l31, l32)


def _solve_scaled(f: _Factors, b: Vector4) -> Vector4:
    """The last pivot times M^-1 b: the pivot that vanishes is never divided by."""
    b0, b1, b2, b3 = b
    b1 = _less(b1, f.l10, b0)
    b2 = _less(_less(b2, f.l20, b0), f.l21, b1)
    b3 = _less(_less(_less(b3, f.l30, b0), f.l31, b1), f.l32, b2)
    return _back(f, b0 * f.s0, b1 * f.s1, b2 * f.s2, b3)


def _start(f: _Factors) -> Vector4:
    """The same for a b of which L^-1 b is constant: nearly M^-1 e4, the inhomogeneous solution.

    The other components reach vectors near infinity, to which e4 is nearly orthogonal.
    """
    return _back(f, 0.13 * f.s0, 0.07 * f.s1, 0.11 * f.s2, torch.ones_like(f.d3))


def _back(f: _Factors, z0: Tensor, z1: Tensor, z2: Tensor, z3: Tensor) -> Vector4:
    z2 = _less(z2, f.l32, z3)
    z1 = _less(_less(z1, f.l21, z2), f.l31, z3)
    z0 = _less(_less(_less(z0, f.l10, z1), f.l20, z2), f.l30, z3)
    return z0, z1, z2, z3


def _solve_in_complement(matrix: Symmetric4, x: Vector4, mu: Tensor, g: Vector4) -> Vector4:
    """(M - mu)^+ g in the 3-space orthogonal to the unit vector x.

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
    q0, q1, q2 = (_less(beta * image[i], half, u[i]) for i in range(3))
    a00 = _less(m00 - mu, 2 * x0, q0)
    a01 = _less(_less(m01, x0, q1), q0, x1)
    a02 = _less(_less(m02, x0, q2), q0, x2)
    a11 = _less(m11 - mu, 2 * x1, q1)
    a12 = _less(_less(m12, x1, q2), q1, x2)
    a22 = _less(m22 - mu, 2 * x2, q2)
    reflect = beta * dot(u, g)
    h0, h1, h2 = _less(g[0], reflect, x0), _less(g[1], reflect, x1), _less(g[2], reflect, x2)

    noise = rounding(matrix)
    i0, definite0 = _reciprocal(a00, noise)
    l10, l20 = a01 * i0, a02 * i0
    i1, definite1 = _reciprocal(_less(a11, l10, a01), noise)
    t = _less(a12, l20, a01)
    l21 = t * i1
    i2, definite2 = _reciprocal(_less(_less(a22, l20, a02), l21, t), noise)
    definite = definite0 & definite1 & definite2
    h1 = _less(h1, l10, h0)
    h2 = _less(_less(h2, l20, h0), l21, h1) * i2
    h1 = _less(h1 * i1, l21, h2)
    h0 = _less(_less(h0 * i0, l10, h1), l20, h2)

    reflect = beta * (x0 * h0 + x1 * h1 + x2 * h2)
    solution = (
        _less(h0, reflect, u[0]), _less(h1, reflect, u[1]), _less(h2, reflect, u[2]),
        -reflect * u[3],
    )  # fmt: skip
    s0, s1, s2, s3 = (torch.where(definite, component, 0.0) for component in solution)
    return s0, s1, s2, s3


def _reciprocal(pivot: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """1 / pivot, and whether it is positive beyond rounding; elsewhere 1, with no gradient."""
    positive = pivot > noise
    return 1 / torch.where(positive, pivot, 1.0), positive
