"""Points of the plane from where distortion took them: Newton's method, and where it has no answer.

Most points are found in a few plain steps. Those that are not, close to where the lens turns back
or between its inflections, are found again with a bracket, which cannot fail.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.cameras.lenses.terms import Pair, Terms, distort_and_derive, gain
from deltas_geom.numerics.arithmetic import surely_all, values_at_hand

_PLAIN, _POLISH, _BRACKETED = 4, 3, 48
_FOLLOWED = 2
"""Steps with gradient, of which each doubles the order to which derivatives are right."""


class Undistorted(NamedTuple):
    """Points of the plane.

    Attributes:
        x, y: ``(*B, N)``; anything where not found.
        found: ``(*B, N)`` bool.
    """

    x: Tensor
    y: Tensor
    found: Tensor


@torch.no_grad()
def undistort(terms: Terms, u: Tensor, v: Tensor, within: Tensor) -> Undistorted:
    """The points that go to (u, v), and whether there is one within the disc that is one to one.

    Args:
        terms: of the distortion.
        u: ``(*B, N)``.
        v: ``(*B, N)``.
        within: ``(*B, 1)`` from :func:`one_to_one_within`.
    """
    first = _solve(terms, u, v, within, _plain_scale(terms, u, v))
    if surely_all(first.found):
        return first
    if not values_at_hand(first.found):
        again = _solve(terms, u, v, within, _bracketed_scale(terms, u, v, within))
        return _either(first, again)
    # Not again what is found: what is not may be few.
    lost = ~first.found
    few_terms = Terms(*(tuple(c.expand(lost.shape)[lost] for c in part) for part in terms))
    few = u.expand(lost.shape)[lost], v.expand(lost.shape)[lost], within.expand(lost.shape)[lost]
    again = _solve(few_terms, *few, _bracketed_scale(few_terms, *few))
    # In place: all three are our own.
    x, y, found = (tensor.contiguous() for tensor in first)
    x[lost], y[lost], found[lost] = again
    return Undistorted(x, y, found)


def follow(terms: Terms, point: Undistorted, u: Tensor, v: Tensor) -> Pair:
    """The found points again, differentiably: by the implicit function theorem.

    Source: Griewank and Walther, Evaluating Derivatives, 2nd ed., chapter 15.
    """
    x, y = point.x.detach(), point.y.detach()
    for _ in range(_FOLLOWED):
        dx, dy = _newton(terms, x, y, u, v)
        x, y = x - dx, y - dy
    return x, y


def _either(first: Undistorted, second: Undistorted) -> Undistorted:
    x = torch.where(first.found, first.x, second.x)
    y = torch.where(first.found, first.y, second.y)
    return Undistorted(x, y, first.found | second.found)


def _plain_scale(terms: Terms, u: Tensor, v: Tensor) -> Tensor:
    """q of which q (u, v) is nearly the point, the radial terms alone being looked at."""
    s = torch.addcmul(u * u, v, v)
    q = torch.ones_like(s)
    for _ in range(_PLAIN):
        _, step = _scale_step(terms, q, s)
        q = q - step
    return q


def _scale_step(terms: Terms, q: Tensor, s: Tensor) -> Pair:
    """q g(q^2 s) - 1, and Newton's step."""
    t = q * q * s
    g, slope = gain(terms, t)
    excess = torch.addcmul(g.new_full((), -1.0), q, g)
    return excess, excess / torch.addcmul(g, slope, 2 * t)


def _bracketed_scale(terms: Terms, u: Tensor, v: Tensor, within: Tensor) -> Tensor:
    """The same between 0 and the end of the disc, by halving where Newton leaves the bracket."""
    s = torch.addcmul(u * u, v, v)
    low = torch.zeros_like(s)
    high = (within * s.clamp(min=torch.finfo(s.dtype).tiny).rsqrt()).clamp(max=1e9)
    q = torch.minimum(torch.ones_like(s), high / 2)
    for _ in range(_BRACKETED):
        excess, step = _scale_step(terms, q, s)
        above = excess > 0
        low, high = torch.where(above, low, q), torch.where(above, q, high)
        newton = q - step
        inside = (newton > low) & (newton < high)
        q = torch.where(inside, newton, (low + high) / 2)
    return q


def _solve(terms: Terms, u: Tensor, v: Tensor, within: Tensor, q: Tensor) -> Undistorted:
    """Points near q (u, v), polished on the plane."""
    x, y = q * u, q * v
    dx = dy = x
    for _ in range(1 if terms.only_radial else _POLISH):
        dx, dy = _newton(terms, x, y, u, v)
        x, y = x - dx, y - dy
    t = torch.addcmul(x * x, y, y)
    # What is left after a step is of the size of its square.
    small = 16 * torch.finfo(x.dtype).eps
    near = torch.addcmul(dx * dx, dy, dy) <= small * t.clamp(min=1)
    return Undistorted(x, y, near & (t < within * within))


def _newton(terms: Terms, x: Tensor, y: Tensor, u: Tensor, v: Tensor) -> Pair:
    """What a step of Newton's on the plane takes from (x, y)."""
    (mx, my), j = distort_and_derive(terms, x, y)
    ex, ey = mx - u, my - v
    determinant = torch.addcmul(j.ux * j.vy, j.uy, j.vx, value=-1)
    dx = torch.addcmul(j.vy * ex, j.uy, ey, value=-1) / determinant
    dy = torch.addcmul(j.ux * ey, j.vx, ex, value=-1) / determinant
    return dx, dy
