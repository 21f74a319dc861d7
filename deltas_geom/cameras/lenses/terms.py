r"""Polynomial distortion of a plane: its terms, its derivative, and how far it is one to one.

A point u of the plane, of slopes or of angles, goes to

.. math:: u\,g(t) + p\,t + 2u\,(p \cdot u) + s_1 t + s_2 t^2, \quad t = |u|^2

g being a polynomial or a quotient of two, p the tangential and s the thin prism's vectors.

Source: Brown, Close-range camera calibration, 1971; OpenCV's calibration documentation.
"""

import math
from collections.abc import Sequence
from itertools import zip_longest
from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.numerics.arithmetic import without_gradients

Pair = tuple[Tensor, Tensor]
_FARTHEST = 1e6  # slope: beyond it is the camera's own plane


class Terms(NamedTuple):
    """Coefficients, each ``(*B, 1)``.

    Attributes:
        radial: of t, t^2, ... in the numerator of g.
        divided: of t, t^2, ... in its denominator.
        tangential: x and y of p, or nothing.
        prism: x and y of s1, then perhaps x and y of s2, or nothing.
    """

    radial: tuple[Tensor, ...] = ()
    divided: tuple[Tensor, ...] = ()
    tangential: tuple[Tensor, ...] = ()
    prism: tuple[Tensor, ...] = ()

    @property
    def only_radial(self) -> bool:
        """Are there no other terms than those of the gain?"""
        return len(self.tangential) + len(self.prism) == 0  # a compiler knows no "not" of tuples


class Jacobian(NamedTuple):
    """Of an image (u, v) by (x, y)."""

    ux: Tensor
    uy: Tensor
    vx: Tensor
    vy: Tensor


def gain(terms: Terms, t: Tensor) -> Pair:
    """g and its derivative by t."""
    g, slope = _polynomial(terms.radial, t)
    if not terms.divided:
        return g, slope
    below, below_slope = _polynomial(terms.divided, t)
    g = g / below
    return g, (slope - g * below_slope) / below


def _polynomial(coefficients: Sequence[Tensor], t: Tensor) -> Pair:
    """1 + c1 t + c2 t^2 + ... and its derivative, by Horner's scheme."""
    if not coefficients:
        return t.new_ones(()), t.new_zeros(())
    value, slope = coefficients[-1], None
    for coefficient in [*coefficients[-2::-1], t.new_ones(())]:
        slope = value if slope is None else torch.addcmul(value, slope, t)
        value = torch.addcmul(coefficient, value, t)
    return value, slope if slope is not None else torch.zeros_like(t)


def distort(terms: Terms, x: Tensor, y: Tensor) -> Pair:
    """Where a point of the plane goes."""
    t = torch.addcmul(x * x, y, y)
    g = _turned(terms, gain(terms, t)[0], 2 * x, 2 * y)
    shift, _ = _shift(terms, t)
    return _moved(x, y, g, shift)


def distort_and_derive(terms: Terms, x: Tensor, y: Tensor) -> tuple[Pair, Jacobian]:
    """Where a point of the plane goes, and the derivative by the point."""
    t = torch.addcmul(x * x, y, y)
    g, slope = gain(terms, t)
    twice_x, twice_y = 2 * x, 2 * y
    g = _turned(terms, g, twice_x, twice_y)
    shift, shift_slope = _shift(terms, t)
    # Half of the derivative of g, all of which is along u for what is radial alone.
    if terms.tangential:
        px, py = terms.tangential
        by_x, by_y = torch.addcmul(px, slope, x), torch.addcmul(py, slope, y)
    else:
        by_x, by_y = slope * x, slope * y
    if not shift_slope:
        uy = twice_x * by_y
        jacobian = torch.addcmul(g, twice_x, by_x), uy, uy, torch.addcmul(g, twice_y, by_y)
    else:
        along_x, along_y = shift_slope
        uy = torch.addcmul(along_x * twice_y, twice_x, by_y)
        jacobian = (
            torch.addcmul(g, twice_x, by_x + along_x),
            uy,
            torch.addcmul(along_y * twice_x, twice_y, by_x) if terms.prism else uy,
            torch.addcmul(g, twice_y, by_y + along_y),
        )
    return _moved(x, y, g, shift), Jacobian(*jacobian)


def _turned(terms: Terms, g: Tensor, twice_x: Tensor, twice_y: Tensor) -> Tensor:
    """All that multiplies u: g(t) + 2 (p . u)."""
    if not terms.tangential:
        return g
    px, py = terms.tangential
    return torch.addcmul(torch.addcmul(g, px, twice_x), py, twice_y)


def _shift(terms: Terms, t: Tensor) -> tuple[Sequence[Tensor], Sequence[Tensor]]:
    """What is added to all points of a circle: (p + s1) t + s2 t^2, and its derivative by t."""
    first = [*terms.tangential] or [*terms.prism[:2]]
    if not first:
        return (), ()
    if terms.tangential and terms.prism:
        first = [p + s for p, s in zip(first, terms.prism, strict=False)]
    second = terms.prism[2:]
    if not second:
        return [a * t for a in first], first
    pairs = list(zip(first, second, strict=True))
    return (
        [torch.addcmul(a, b, t) * t for a, b in pairs],
        [torch.addcmul(a, b, t, value=2) for a, b in pairs],
    )


def _moved(x: Tensor, y: Tensor, g: Tensor, shift: Sequence[Tensor]) -> Pair:
    if not shift:
        return x * g, y * g
    return torch.addcmul(shift[0], x, g), torch.addcmul(shift[1], y, g)


@without_gradients
def one_to_one_within(terms: Terms, most: float = math.inf) -> Tensor:
    """The radius of the disc around the axis in which distortion is one to one, ``(*B, 1)``.

    In it the symmetric part of the derivative is positive definite, and a map of a convex domain
    of which this holds takes no value twice. Without other terms than radial ones it ends
    exactly where r g(r^2) turns back, or has a pole; a tangential vector p takes 6 |p| r from the
    derivative where it takes most, a prism 2 |s1| r + 4 |s2| r^3. ``most`` is the radius where
    nothing turns back; pi for angles.
    """
    limit = min(most, _FARTHEST)
    one = torch.ones_like(next(c for part in terms for c in part))
    # Coefficients of powers of t, in a list.
    above, below = [one, *terms.radial], [one, *terms.divided]
    steepness = [torch.zeros_like(one) for _ in [*above, *below[1:]]]
    for i, a in enumerate(above):
        for k, b in enumerate(below):
            steepness[i + k] = torch.addcmul(steepness[i + k], a, b, value=1 + 2 * (i - k))
    if terms.only_radial:
        first = _first_root(steepness[1:]).sqrt()
    else:
        # What the others take has the odd powers of r.
        p, s1, s2 = _sizes(terms, one)
        odd = _product([-6 * p - 2 * s1, -4 * s2], _product(below, below))
        pairs = zip_longest(steepness, odd, fillvalue=torch.zeros_like(one))
        first = _first_root([part for pair in pairs for part in pair][1:])
    if terms.divided:
        # At a pole itself there is no number.
        pole = _first_root(list(terms.divided)).sqrt() * (1 - 1e-9)
        first = torch.minimum(first, pole)
    return first.clamp(max=limit)


def image_radius(terms: Terms, within: Tensor) -> Tensor:
    """A circle outside of which nothing of the disc ``within`` goes, ``(*B, 1)``."""
    t, (p, s1, s2) = within * within, _sizes(terms, within)
    radius = within * gain(terms, t)[0] + (3 * p + s1 + s2 * t) * t
    return radius * (1 + 1e-9)


def _sizes(terms: Terms, like: Tensor) -> list[Tensor]:
    """Lengths of p, s1 and s2, 0 for those that there are not."""
    none = torch.zeros_like(like)
    vectors = terms.tangential, terms.prism[:2], terms.prism[2:]
    return [torch.hypot(*vector) if vector else none for vector in vectors]


def _product(a: Sequence[Tensor], b: Sequence[Tensor]) -> list[Tensor]:
    """Coefficients of the product of two polynomials."""
    found = [torch.zeros_like(a[0]) for _ in [*a, *b[1:]]]
    for i, first in enumerate(a):
        for k, second in enumerate(b):
            found[i + k] = torch.addcmul(found[i + k], first, second)
    return found


def _first_root(coefficients: Sequence[Tensor]) -> Tensor:
    """The smallest positive root of 1 + c1 z + c2 z^2 + ..., infinite if there is none."""
    c = torch.stack(list(coefficients), dim=-1)
    size = c.shape[-1]
    # The companion matrix of z^n times the polynomial of 1/z, whose leading coefficient is 1.
    below = torch.eye(size, device=c.device, dtype=c.dtype)[:-1].expand(*c.shape[:-1], -1, -1)
    inverse = torch.linalg.eigvals(torch.cat([-c.unsqueeze(-2), below], dim=-2))
    # Two roots that are nearly one are a bit apart from the real line, by the root of rounding.
    close = 64 * math.sqrt(torch.finfo(c.dtype).eps)
    real = inverse.imag.abs() <= close * inverse.real
    # Of coefficients that are all 0 the largest may be -0, whose reciprocal is not the same.
    return torch.where(real, inverse.real, 0.0).amax(dim=-1).clamp(min=0).abs().reciprocal()
