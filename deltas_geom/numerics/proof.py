"""Null vectors of symmetric 4x4 matrices by two inverse iterations, where proved to be enough.

The residual by a lower bound of the second eigenvalue bounds the error of each. Good matches need
no more, and gross outliers fail it.

Source: Golub and Van Loan, 4th ed., sections 8.1.3 (bounds) and 8.2 (inverse iteration).
"""

import torch
from torch import Tensor

from deltas_geom.numerics.ldl import eliminate, rounding_of, solve_leading
from deltas_geom.numerics.vectors import Symmetric4, Vector4, dot, less, plus


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

    trace = matrix[0] + matrix[4] + matrix[7] + matrix[9]
    inverse = (0.5 * trace).square() * f.i0 * f.i1 * f.i2  # 1 / s
    # A tenth, and of an eigenvalue that holds the noise, is more than rounding can feign.
    share = (t.abs() + rounding_of(trace)) * inverse
    apart = (share > 0) & (share <= 0.1)
    ratio = share / size
    # |y| >= |x|, since p^T A^-1 p is positive; the residual is t^2 times q across x.
    along = dot(p, q)
    across = less(dot(q, q) * size, along, along)  # squared, times |x|^2
    bound = (ratio * ratio * t).square() * across
    proved = apart & (bound <= (0.9 * accuracy) ** 2 * size.square())
    return (*x, torch.full_like(t, -1.0)), proved
