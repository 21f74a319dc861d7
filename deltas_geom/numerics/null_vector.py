"""The null vector of symmetric 4x4 matrices (ldl.py), by arithmetic alone.

The route is LDL with the last coordinate eliminated last (robust to the world's unit and
origin), and inverse iterations. Two are all where a bound on the error proves those to be enough:
good matches need no more, and gross outliers fail it. Elsewhere a Rayleigh quotient iteration
follows, and a count of the eigenvalues below.
Gradients come from one more Rayleigh step, solved in the complement of the vector, where they
stay finite when other eigenvalues meet (there SVD's are NaN).

Source: Golub and Van Loan, 4th ed., sections 8.1.4 (inertia), 8.1.3 (bounds) and 8.2; the step is
cubically convergent, so its first and second derivatives at the solution are exact.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.numerics.arithmetic import surely_all, values_at_hand, without_gradients
from deltas_geom.numerics.ldl import (
    Factors,
    eliminate,
    factor,
    multiply,
    rounding,
    shifted,
    solve_leading,
    solve_scaled,
    start,
    trace_of,
)
from deltas_geom.numerics.symmetric3 import solve3
from deltas_geom.numerics.vectors import (
    Symmetric4,
    Vector4,
    dot,
    either,
    less,
    minus,
    plus,
    scaled,
    unit,
)

# After the start. One is enough for good matches; gross outliers bring eigenvalues near.
_INVERSE_ITERATIONS = 2


class NullVector(NamedTuple):
    """A null vector and whether it is one.

    Attributes:
        vector: of any length and sign, without gradient. Not finite at worst where not simple.
        simple: bool; False where the smallest eigenvalue is not apart from the others by more
            than rounding (the vector is then arbitrary), or the matrix is not finite.
    """

    vector: Vector4
    simple: Tensor


@without_gradients
def null_vector(
    matrix: Symmetric4,
    *,
    accuracy: float = 0.0,
    product: Callable[[Vector4], Vector4] | None = None,
    polish: int = 0,
) -> NullVector:
    """Vector x that minimises x^T M x / x^T x.

    Args:
        matrix: positive semidefinite.
        accuracy: an error that does not matter, rad; from 1e-9 it saves time.
        product: M x, computed more exactly than from M: for M = A^T A, A^T (A x).
        polish: corrections by ``product``, each of which takes the vector from the accuracy that
            M allows nearer to that of A.
    """
    if polish > 0 or accuracy < 1e-9 or not values_at_hand(matrix[0]):
        return _iterated(matrix, product=product, polish=polish)
    vector, proved = proved_vector(matrix, accuracy)
    if surely_all(proved):
        return NullVector(vector, proved)
    hard = proved.logical_not().flatten().nonzero().squeeze(-1)
    some = _iterated(tuple(entry.flatten().index_select(0, hard) for entry in matrix))

    def merged(easy: Tensor, other: Tensor) -> Tensor:
        return easy.flatten().index_copy(0, hard, other).view_as(easy)

    return NullVector(tuple(map(merged, vector, some.vector)), merged(proved, some.simple))


def proved_vector(matrix: Symmetric4, accuracy: float) -> tuple[Vector4, Tensor]:
    """Vectors by two inverse iterations, and which of them are proved to be within ``accuracy``.

    For M = [A b; b^T c] they start from x = (p, 1) with A p = -b, where M x = d3 e4. The first
    yields y = x + t (A^-1 p, 0), M y = t x, with t = d3 / |x|^2, an upper bound of the eigenvalue.
    The error of y is at most its residual by the distance to the second eigenvalue. The second
    iteration divides it by at least the ratio of the two. The smallest eigenvalue of A is not below
    s = 4 det A / trace(M)^2, nor the second of M, det M by the product of the others, below
    s |x|^2.
    """
    f = eliminate(matrix)
    p2 = f.l32  # p and q = A^-1 p, both negative
    p1 = less(f.l31, f.l21, p2)
    p0 = less(less(f.l30, f.l10, p1), f.l20, p2)
    p = p0, p1, p2
    q = solve_leading(f, p)
    size = 1 + dot(p, p)
    t = f.d3 / size
    y = plus(p, t, q)
    x = plus(p, f.d3 / (1 + dot(p, y)), solve_leading(f, y))

    trace = trace_of(matrix)
    inverse = (0.5 * trace).square() * f.i0 * f.i1 * f.i2  # 1 / s
    # A tenth, and of an eigenvalue that holds the noise, is more than rounding can feign.
    share = (t.abs() + rounding(trace)) * inverse
    apart = (share > 0) & (share <= 0.1)
    ratio = share / size
    # |y| >= |x|, since p^T A^-1 p is positive; the residual is t^2 times q across x.
    along = dot(p, q)
    across = less(dot(q, q) * size, along, along)  # squared, times |x|^2
    bound = (ratio * ratio * t).square() * across
    proved = apart & (bound <= (0.9 * accuracy) ** 2 * size.square())
    return (*x, torch.full_like(t, -1.0)), proved


def _iterated(
    matrix: Symmetric4, *, product: Callable[[Vector4], Vector4] | None = None, polish: int = 0
) -> NullVector:
    noise = rounding(trace_of(matrix))
    # Above the null space by the rounding of M, every pivot is positive.
    factors = factor(shifted(matrix, -noise))
    x = start(factors)
    for _ in range(_INVERSE_ITERATIONS - 1):
        x = solve_scaled(factors, x)
    x = unit(x)  # before it overflows: towards infinity each solve makes it longer
    near = solve_scaled(factors, x)
    length = dot(near, near)
    quotient = factors.pivots.d3 * dot(near, x) / length - noise
    near, quotient = _nearer(matrix, scaled(near, length.rsqrt()), quotient, noise)

    # Just above one eigenvalue, one pivot is negative (Sylvester's law of inertia).
    factors = factor(shifted(matrix, quotient + noise))
    p = factors.pivots
    simple = p.i0.sign() + p.i1.sign() + p.i2.sign() + p.d3.sign() == 2
    vector = solve_scaled(factors, near)
    if product is not None:
        for _ in range(polish):
            vector = _polished(factors, unit(vector), product)
    return NullVector(vector, simple)


def _nearer(
    matrix: Symmetric4, a: Vector4, quotient: Tensor, noise: Tensor
) -> tuple[Vector4, Tensor]:
    """A Rayleigh quotient iteration, and the smallest of what it and its start span.

    Between two close eigenvalues the iteration alone may stay where it is, or leave for the
    larger one; in the plane of both (Rayleigh-Ritz) the smaller one is found. Vectors the squared
    sine of whose angle is lost in rounding count as one.

    From a unit vector and its quotient a^T M a to a vector of any length and its quotient;
    ``noise`` is the rounding of an eigenvalue.
    """
    # Off the quotient itself, where a pivot of a simple matrix may vanish exactly.
    below = -0.4 * noise
    factors = factor(shifted(matrix, quotient - below))
    same = 256 * torch.finfo(noise.dtype).eps
    b = solve_scaled(factors, a)  # K b = d3 a with K = M - shift, and a^T K a = below
    along, length = dot(a, b), dot(b, b)
    across = less(length, along, along)
    # K in the plane, times across: below * across, g * sqrt(across), -along * g.
    g = less(factors.pivots.d3, below, along)
    half = 0.5 * torch.addcmul(below * across, along, g)
    step = half + torch.addcmul(half * half, g * g, across).clamp(min=0).sqrt()
    # Where both are one, or both quotients, within rounding, the iteration has converged.
    flat = (across <= same * length) | (g.abs() <= noise)
    zero, one = noise.new_zeros(()), noise.new_ones(())
    of_a = torch.where(flat, zero, torch.addcmul(g * across, step, along))
    of_b = torch.where(flat, one, -step)
    nearer = plus(scaled(a, of_a), of_b, b)
    change = torch.where(flat, below - factors.pivots.d3 * along / length, step / across)
    return nearer, quotient - change


def _polished(factors: Factors, x: Vector4, product: Callable[[Vector4], Vector4]) -> Vector4:
    """x - (M - mu)^+ (M x - mu x), mu = x^T M x: Newton's method in the complement of x."""
    image = product(x)
    mu = dot(x, image)
    change = solve_scaled(factors, minus(image, mu, x))
    # What the solve amplifies is along x, and goes.
    return minus(x, factors.pivots.d3.reciprocal(), minus(change, dot(x, change), x))


def rayleigh_step(matrix: Symmetric4, x: Vector4) -> Vector4:
    """x - (M - mu)^+ (M x), mu = x^T M x: the null vector with its derivatives, and the value x.

    x has unit length and no gradient. Where M - mu is not definite in its complement, there are no
    derivatives.
    """
    image = multiply(matrix, x)
    # M x is mu x but for rounding, which the derivative of the inverse would multiply: by 1e9 where
    # all but one of the weights are 1e-6.
    moved = tuple(component - component.detach() for component in image)
    change = solve_in_complement(matrix, x, dot(x, image), moved)
    return tuple(before - by for before, by in zip(x, change, strict=True))


def solve_in_complement(matrix: Symmetric4, x: Vector4, mu: Tensor, g: Vector4) -> Vector4:
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
    q0, q1, q2 = (less(beta * image[i], half, u[i]) for i in range(3))
    a00 = less(m00 - mu, 2 * x0, q0)
    a01 = less(less(m01, x0, q1), q0, x1)
    a02 = less(less(m02, x0, q2), q0, x2)
    a11 = less(m11 - mu, 2 * x1, q1)
    a12 = less(less(m12, x1, q2), q1, x2)
    a22 = less(m22 - mu, 2 * x2, q2)
    reflect = beta * dot(u, g)
    h, definite = solve3((a00, a01, a02, a11, a12, a22), minus(g[:3], reflect, x[:3]))
    reflect = beta * dot(x[:3], h)
    solution = (*minus(h, reflect, u[:3]), -reflect * u[3])
    return either(definite, solution, (0.0,) * 4)
