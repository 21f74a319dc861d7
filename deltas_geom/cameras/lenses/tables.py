"""A function of a squared radius as many cubic pieces, to be read at very many places.

A lens bends all pixels of a circle alike, so that what takes an iteration for a pixel is a function
of one number. It is asked at 256 places, which give polynomials of degree 15 on 16 panels; these
are cut into pieces of degree 3, which are faster to read. Where either is not as exact as
arithmetic is known, and not read.
"""

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np

from deltas_geom.numerics.vectors import Array

_PANELS, _DEGREE, _PIECES = 16, 15, 128  # pieces of a panel
# Of values at 0, 1/3, 2/3 and 1 less the first, the coefficients of x, x^2 and x^3.
_CUBIC = np.array([[9.0, -4.5, 1.0], [-22.5, 18.0, -4.5], [13.5, -13.5, 4.5]])
_REMAINDER = 324
"""A cubic through such values misses by at most h^4 f'''' / 1944; from a piece to the next the last
coefficient changes by h^4 f'''' / 6."""


class Table(NamedTuple):
    """The pieces.

    Attributes:
        coefficients: four of ``(P,)``, of powers of the share of a piece, the last power first.
        per_unit: pieces per unit of the squared radius.
        exact: the squared radius up to which the function is read to rounding.
        ends: that from which on it has no values.
    """

    coefficients: Array
    per_unit: float
    exact: float
    ends: float

    def read(self, squared: Array, place: Array, index: Array, work: Array, out: Array) -> None:
        """Values at squared radii ``(N,)``, into ``out``; from ``exact`` on those of places before.

        All others are to work in; ``index`` holds integers of a pointer's size.
        """
        np.multiply(squared, self.per_unit, out=place)
        np.floor(place, out=work)
        np.copyto(index, work, casting="unsafe")
        np.subtract(place, work, out=place)
        cubic, *others = self.coefficients
        np.take(cubic, index, out=out, mode="clip")
        for coefficients in others:
            np.multiply(out, place, out=out)
            np.take(coefficients, index, out=work, mode="clip")
            np.add(out, work, out=out)


def table_of(
    function: Callable[[Array], tuple[Array, Array]], end: float, tolerance: float
) -> Table | None:
    """The table of a function of a squared radius, or None where it has no piece to be read.

    From squared radii ``(N,)``, positive and ascending, it gives values and whether there is one;
    what has none comes after what has. The tolerance is relative.
    """
    places, to_series, to_pieces = _matrices()
    squared = ((np.arange(_PANELS)[:, None] + places) * (end / _PANELS)).ravel()
    values, known = function(squared)
    values = np.where(known, values, 0.0).reshape(_PANELS, -1)
    size = tolerance * np.abs(values).max(axis=-1)
    # A panel's series is as exact as its last terms are small.
    last = np.abs(values @ to_series).max(axis=-1)
    sound = known.reshape(values.shape).all(axis=-1) & (last < size)  # NaN is not below
    pieces = (values @ to_pieces).reshape(_PANELS, 4, _PIECES)
    missed = np.abs(np.diff(pieces[:, 0])).max(axis=-1) / _REMAINDER
    good = sound & (missed < size)
    count = _PANELS if good.all() else int(good.argmin())
    if count == 0:
        return None
    coefficients = pieces.swapaxes(0, 1).reshape(4, -1)[:, : count * _PIECES]
    ends = np.inf if known.all() else float(squared[known.argmin()])
    return Table(coefficients, _PANELS * _PIECES / end, count * end / _PANELS, ends)


@cache
def _matrices() -> tuple[Array, Array, Array]:
    """A panel's places; from values there the last terms of its series, and its pieces.

    Source: Trefethen, Approximation Theory and Approximation Practice, chapters 2 to 4.
    """
    # Differences of neighbours lose digits, which here are there to be lost.
    angles = (np.arange(_DEGREE, -1, -1) + np.longdouble(0.5)) * (np.pi / (_DEGREE + 1))
    places = np.cos(angles)
    basis = np.polynomial.chebyshev.chebvander
    to_series = basis(places, _DEGREE) * (np.longdouble(2) / (_DEGREE + 1))
    to_series[:, 0] /= 2
    nodes = np.linspace(np.longdouble(-1), np.longdouble(1), 3 * _PIECES + 1)
    values = to_series @ basis(nodes, _DEGREE).T
    first = values[:, :-1:3]
    apart = [values[:, k::3][:, :_PIECES] - first for k in (1, 2, 3)]
    powers = [sum(c * part for c, part in zip(row, apart, strict=True)) for row in _CUBIC]
    to_pieces = np.concatenate([*powers[::-1], first], axis=-1)
    wanted = ((places + 1) / 2, to_series[:, -2:], to_pieces)
    return tuple(each.astype(np.float64) for each in wanted)  # type: ignore[return-value]
