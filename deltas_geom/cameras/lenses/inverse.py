"""Points of the plane from where distortion took them: Newton's method, and where it has no answer.

Most points are found in a few plain steps. Those that are not, close to where the lens turns back
or between its inflections, are found again with a bracket, which cannot fail.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.cameras.lenses.angles import root
from deltas_geom.cameras.lenses.terms import Pair, Terms, distort_and_derive, gain, image_radius
from deltas_geom.numerics.arithmetic import surely_all, values_at_hand, without_gradients
from deltas_geom.numerics.vectors import either
from deltas_geom.records import mapped

_PLAIN, _ROUGH, _POLISH, _BRACKETED, _CAREFUL = 4, 2, 2, 60, 20
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


@without_gradients
def undistort(terms: Terms, u: Tensor, v: Tensor, within: Tensor) -> Undistorted:
    """The points that go to (u, v), each ``(*B, N)``, and whether there is one ``within`` the disc
    of :func:`one_to_one_within`.
    """
    first = _solve(terms, u, v, within)
    if surely_all(first.found):
        return first
    # Beyond what the whole disc goes to there is no point to look for.
    lost = ~first.found & (torch.addcmul(u * u, v, v) <= image_radius(terms, within).square())
    if not values_at_hand(first.found):
        again = _solve_safely(terms, u, v, within)
        x, y = either(first.found, first[:2], again[:2])
        return Undistorted(x, y, first.found | again.found)
    # Not again what is found: what is not may be few.
    few_terms = Terms(*(tuple(c.expand(lost.shape)[lost] for c in part) for part in terms))
    few = (each.expand(lost.shape)[lost] for each in (u, v, within))
    again = _solve_safely(few_terms, *few)
    # In place: all three are our own.
    x, y, found = (each.expand(lost.shape).contiguous() for each in first)
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


def _solve(terms: Terms, u: Tensor, v: Tensor, within: Tensor) -> Undistorted:
    """The points by plain steps, of which the first are in float32: a pass takes half the time.

    Those are not found whose numbers are too large for it, or that steps lead away from.
    """
    single: tuple[Terms, Tensor, Tensor] = mapped(Tensor.float, (terms, u, v))
    q = _plain_scale(*single)
    if terms.only_radial:
        return _on_line(terms, u, v, within, q.to(u.dtype), _POLISH)
    terms_, u_, v_ = single
    x, y = q * u_, q * v_
    for _ in range(_ROUGH):
        dx, dy = _newton(terms_, x, y, u_, v_)
        x, y = x - dx, y - dy
    return _on_plane(terms, u, v, within, x.to(u.dtype), y.to(v.dtype))


def _plain_scale(terms: Terms, u: Tensor, v: Tensor) -> Tensor:
    """q of which q (u, v) is nearly the point, the radial terms alone being looked at."""
    s = torch.addcmul(u * u, v, v)
    q = torch.ones_like(s)
    if not terms.radial and not terms.divided:
        return q
    # Where other terms are to come they move the point by more than this.
    enough = 1e-3 if terms.only_radial else 3e-2
    for _ in range(_PLAIN):
        _, step = _scale_step(terms, q, s)
        q = q - step
        if surely_all(step.abs() < enough):
            break
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
    last, tiny = high, 64 * torch.finfo(s.dtype).eps
    for _ in range(_BRACKETED):
        excess, step = _scale_step(terms, q, s)
        above = excess > 0
        low, high = torch.where(above, low, q), torch.where(above, q, high)
        newton = q - step
        size = step.abs()
        # Not where steps hardly shrink, as of a power high above its root; but at the root.
        shrinks = (2 * size < last) | (size <= tiny * q)
        good = (newton >= low) & (newton <= high) & shrinks
        following = torch.where(good, newton, (low + high) / 2)
        last, q = (following - q).abs(), following
    return q


def _on_line(
    terms: Terms, u: Tensor, v: Tensor, within: Tensor, q: Tensor, steps: int
) -> Undistorted:
    """Points near q (u, v) of a distortion that leaves them on their lines through the axis."""
    s = torch.addcmul(u * u, v, v)
    step = q
    for _ in range(steps):
        _, step = _scale_step(terms, q, s)
        q = q - step
    t = q * q * s
    near = step * step * s <= _close(t)
    return Undistorted(q * u, q * v, near & (t < within * within))


def _on_plane(
    terms: Terms, u: Tensor, v: Tensor, within: Tensor, x: Tensor, y: Tensor
) -> Undistorted:
    """Points near (x, y)."""
    dx = dy = x
    for _ in range(_POLISH):
        dx, dy = _newton(terms, x, y, u, v)
        x, y = x - dx, y - dy
    return _judged(x, y, dx, dy, within)


def _solve_safely(terms: Terms, u: Tensor, v: Tensor, within: Tensor) -> Undistorted:
    """The same from a bracket, by steps that stay in the disc."""
    q = _bracketed_scale(terms, u, v, within)
    if terms.only_radial:
        return _on_line(terms, u, v, within, q, 1)
    x, y = q * u, q * v
    dx = dy = x
    for _ in range(_CAREFUL):
        dx, dy = _newton(terms, x, y, u, v)
        t = torch.addcmul(x * x, y, y)
        x, y = x - dx, y - dy
        new = torch.addcmul(x * x, y, y)
        # Half of the way to the border, where a step would leave.
        halfway = (root(t) + within) / 2 * new.rsqrt()
        scale = torch.where(new < within * within, 1.0, halfway)
        x, y = x * scale, y * scale
    return _judged(x, y, dx, dy, within)


def _judged(x: Tensor, y: Tensor, dx: Tensor, dy: Tensor, within: Tensor) -> Undistorted:
    """Which points solve the equations after a last step, and within the disc."""
    t = torch.addcmul(x * x, y, y)
    near = torch.addcmul(dx * dx, dy, dy) <= _close(t)
    return Undistorted(x, y, near & (t < within * within))


def _close(t: Tensor) -> Tensor:
    """The square of a last step: what is left after a step is of the size of that."""
    return 16 * torch.finfo(t.dtype).eps * t.clamp(min=1)


def _newton(terms: Terms, x: Tensor, y: Tensor, u: Tensor, v: Tensor) -> Pair:
    """What a step of Newton's on the plane takes from (x, y)."""
    (mx, my), j = distort_and_derive(terms, x, y)
    ex, ey = mx - u, my - v
    determinant = torch.addcmul(j.ux * j.vy, j.uy, j.vx, value=-1)
    dx = torch.addcmul(j.vy * ex, j.uy, ey, value=-1) / determinant
    dy = torch.addcmul(j.ux * ey, j.vx, ex, value=-1) / determinant
    return dx, dy
