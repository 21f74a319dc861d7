"""Rays of very many pixels of one lens that bends all places of a circle alike.

Such a ray depends on the distance from the centre alone, but for its turn around the axis. With b
the tangent of half of its angle from the axis, divided by that distance, it is

.. math:: (2bu, 2bv, 1 - m) / (1 + m), \\quad m = b^2 (u^2 + v^2)

of length 1 to rounding, in front of the lens and behind it; b is read from a table that the model's
own rays make. Everything else is a few passes over numbers that stay in the cache, in NumPy, whose
passes take half of torch's time. What the table does not hold is left to the model. Where the plane
itself is distorted, by a prism behind the lens, that is undone first.
"""

import math
from collections.abc import Callable
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from deltas_geom.cameras.lenses.closed import Coefficients, Seen
from deltas_geom.cameras.lenses.models import Model
from deltas_geom.cameras.lenses.tables import Table, table_of
from deltas_geom.numerics.arithmetic import outside_gradients
from deltas_geom.numerics.chunks import alike
from deltas_geom.numerics.vectors import Array

MANY = 32768
"""Pixels from which on a table is worth being made."""
_CHUNK = 25600
_SAMPLED = 512  # pixels, for how far the table goes
_TOLERANCE = 1e-13
_FARTHEST = 1e24
_KEPT = 16
"""Tables, of 64 kB each: whoever has many images of a lens asks for its rays again and again."""
_Rays = tuple[Tensor, Tensor]
_Plane = Callable[[Array, Array, Array], Array | None]
"""Writes where pixels ``(N, 2)`` are on the plane, ``(N,)`` twice; which are, None for all."""


class RaysOfMany(NamedTuple):
    """A function of pixels.

    Attributes:
        plane: takes pixels to the plane.
        table: of b by the squared radius on the plane.
        others: rays ``(N, 3)`` and whether ``(N,)`` of pixels ``(N, 2)`` by the model itself.
    """

    plane: _Plane
    table: Table
    others: Callable[[Tensor], _Rays]

    def __call__(self, pixels: Tensor) -> _Rays:
        """Rays ``(*B, N, 3)`` of pixels ``(*B, N, 2)``, and which are valid ``(*B, N)``."""
        count = alike(pixels.shape[:-1].numel(), _CHUNK)
        # What lies between pixels and rays; it stays in the cache.
        buffers = np.empty((6, count)), np.empty(count, dtype=np.intp)
        with np.errstate(all="ignore"):
            return _filled(partial(self._some, *buffers), pixels)

    def _some(
        self, buffers: Array, whole: Array, pixels: Tensor, rays: Tensor, valid: Tensor
    ) -> None:
        u, v, s, b, place, work = buffers[:, : len(pixels)]
        whole = whole[: len(pixels)]
        placed = self.plane(pixels.numpy(), u, v)
        np.multiply(u, u, out=s)
        np.multiply(v, v, out=work)
        np.add(s, work, out=s)
        if placed is not None:
            np.copyto(s, np.inf, where=~placed)
        self.table.read(s, place, whole, work, out=b)
        known = valid.numpy()
        # The largest of numbers and NaN is NaN, which is not below.
        if s.max() < self.table.exact:
            known[:] = True
        else:
            np.less(s, self.table.exact, out=known)
        out = rays.numpy()
        np.multiply(b, b, out=work)
        np.multiply(work, s, out=work)
        np.add(work, 1.0, out=work)
        np.divide(2.0, work, out=work)
        np.subtract(work, 1.0, out=out[:, 2], casting="same_kind")
        np.multiply(b, work, out=b)
        np.multiply(u, b, out=out[:, 0], casting="same_kind")
        np.multiply(v, b, out=out[:, 1], casting="same_kind")
        if not known.all():
            rays[~valid] = 0.0
            # Beyond the end of the model there is no ray to look for.
            left = torch.from_numpy(np.flatnonzero(~known & ~(s >= self.table.ends)))
            rays[left], valid[left] = self.others(pixels[left])


def by_chunks(function: Callable[[Tensor], _Rays], pixels: Tensor) -> _Rays:
    """The function's rays and masks, some pixels at a time."""

    def some(pixels: Tensor, rays: Tensor, valid: Tensor) -> None:
        rays[:], valid[:] = function(pixels)

    return _filled(some, pixels)


def _filled(some: Callable[[Tensor, Tensor, Tensor], None], pixels: Tensor) -> _Rays:
    """What is written for some pixels at a time; to join parts would take longer than all else."""
    flat = pixels.detach().reshape(-1, 2)
    rays, valid = flat.new_empty(len(flat), 3), flat.new_empty(len(flat), dtype=torch.bool)
    few = alike(len(flat), _CHUNK)
    for start in range(0, len(flat), few):
        part = slice(start, start + few)
        some(flat[part], rays[part], valid[part])
    return rays.reshape(*pixels.shape[:-1], 3), valid.reshape(pixels.shape[:-1])


def _along_x(K: Array, pixels: Array, u: Array, v: Array) -> None:
    """As :data:`_Plane`, in px along x, which saves two divisions."""
    (fx, skew, cx), (_, fy, cy), _ = K
    np.subtract(pixels[:, 0], cx, out=u)
    np.subtract(pixels[:, 1], cy, out=v)
    if skew:
        np.subtract(u, skew / fy * v, out=u)
    if fx != fy:
        np.multiply(v, fx / fy, out=v)


def _undistorted(
    K: Array, undone: Callable[[Tensor, Tensor], Seen], pixels: Array, u: Array, v: Array
) -> Array | None:
    """As :data:`_Plane`, whose distortion is undone."""
    _along_x(K, pixels, u, v)
    np.divide(u, K[0, 0], out=u)
    np.divide(v, K[0, 0], out=v)
    x, y, found = undone(torch.from_numpy(u), torch.from_numpy(v))
    np.copyto(u, x.numpy())
    np.copyto(v, y.numpy())
    return None if found.all() else found.numpy()


def _sampled_end(plane: _Plane, pixels: Tensor) -> float:
    """A squared radius on the plane that few pixels exceed, of few that there are."""
    flat = pixels.detach().reshape(-1, 2)
    some = flat[:: max(1, len(flat) // _SAMPLED)].numpy()
    u, v = np.empty(len(some)), np.empty(len(some))
    placed = plane(some, u, v)
    squared = u * u + v * v
    squared = squared if placed is None else squared[placed]
    # Sorting puts NaN last. One pixel far away must not make the table coarse for all others.
    most = 1.2 * float(np.sort(squared)[int(0.98 * (len(squared) - 1))]) if len(squared) else 0.0
    if not 0 < most < _FARTHEST:
        return 0.0
    # Other pixels of the same lens are to ask for the same table.
    return float(2.0 ** (math.ceil(4 * math.log2(most)) / 4))


@lru_cache(maxsize=_KEPT)
def _table(
    model: Model, coefficients: tuple[float, ...], reach: tuple[float, ...], unit: float, end: float
) -> Table | None:
    """The table of b, by squared radii in units of which ``unit`` are one of the plane."""
    terms = [torch.tensor([each], dtype=torch.float64) for each in coefficients]
    within = torch.tensor(reach, dtype=torch.float64)

    def half_tangents(squared: Array) -> tuple[Array, Array]:
        u = torch.from_numpy(np.sqrt(squared) / unit)
        x, _, z, known = model.rays(terms, within, u, torch.zeros_like(u), False)
        return (x / ((1 + z) * u * unit)).numpy(), known.numpy()

    with outside_gradients():
        return table_of(half_tangents, end, _TOLERANCE)


def rays_around_axis(
    model: Model,
    K: Tensor,
    coefficients: Coefficients,
    reach: Tensor,
    pixels: Tensor,
    others: Callable[[Tensor], _Rays],
) -> RaysOfMany | None:
    """The function of pixels, if there is a table for most of them.

    Of a finite K ``(3, 3)`` and coefficients ``(1,)`` each, of a model whose rays turn with their
    places around the axis. Some pixels tell how far the table goes; ``others`` takes the rest.
    """
    plain = K.numpy()
    unit = 1.0 if model.undone else float(plain[0, 0])
    plane: _Plane = partial(_along_x, plain)
    if model.undone is not None:
        before = model.undone
        plane = partial(_undistorted, plain, lambda u, v: before(coefficients, reach, u, v, False))
    with np.errstate(all="ignore"):
        end = _sampled_end(plane, pixels)
        if not end:
            return None
        given = tuple(float(each) for each in coefficients), tuple(reach.tolist())
        table = _table(model, *given, unit, end)
    return None if table is None else RaysOfMany(plane, table, others)
