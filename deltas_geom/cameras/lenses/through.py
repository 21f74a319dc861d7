"""How points and pixels pass a lens: cameras cleaned once, some items at a time, in float64."""

from collections.abc import Callable, Sequence
from functools import partial

import torch
from torch import Tensor

from deltas_geom.cameras.lenses.many import MANY, by_chunks, rays_around_axis
from deltas_geom.cameras.lenses.models import MODELS
from deltas_geom.cameras.projection import entries_of
from deltas_geom.cameras.views import finite_intrinsics
from deltas_geom.checks import batch_shape, check_shapes
from deltas_geom.numerics.arithmetic import (
    finite_or_zero,
    only,
    outside_gradients,
    promoted,
    solver_dtype,
    surely_below,
    unless_all,
    values_at_hand,
    without_autocast,
)
from deltas_geom.numerics.chunks import Cut, alike
from deltas_geom.numerics.evaluation import differentiated, recomputed
from deltas_geom.numerics.vectors import as_one

_LARGEST = 1e30  # of a coefficient, or a pixel in focal lengths
_FAR = 1e60  # of a coordinate
_CACHED = 25600
"""Items at a time, so that what lies between stays in the cache and no threads start."""
_Both = tuple[Tensor, Tensor]


@without_autocast
def pixels_of_points(K: Tensor, coefficients: Tensor, points: Tensor, model: str) -> _Both:
    """Pixels of points in the camera's frame through a model, and which are valid."""
    check_shapes(points=(points, "N 3"))
    return _through(partial(_pixels, model), model, K, coefficients, points, None)


@without_autocast
def rays_of_pixels(K: Tensor, coefficients: Tensor, pixels: Tensor, model: str) -> _Both:
    """Rays of pixels, and which are valid."""
    check_shapes(pixels=(pixels, "N 2"))
    return _through(partial(_rays, model), model, K, coefficients, pixels, _rays_of_many)


def _through(
    function: Callable[..., _Both],
    model: str,
    K: Tensor,
    coefficients: Tensor,
    items: Tensor,
    prepare: Callable[..., Callable[..., _Both] | None] | None,
) -> _Both:
    """``function`` of cleaned cameras and some items at a time, in the solver's type.

    Many items of one lens are looked at first: ``prepare`` may find a faster way for their values.
    """
    batch = batch_shape(K.shape[:-2], coefficients.shape[:-1], items.shape[:-2])
    K, coefficients, items = promoted(K, coefficients, items)
    dtype = solver_dtype(items)
    # Cameras are few: looked at here, once for all items.
    K, known = finite_intrinsics(K.to(dtype))
    coefficients, sound = coefficients.to(dtype), None
    if coefficients.shape[-1]:  # there is no largest of none
        coefficients, sound = finite_or_zero(coefficients, limit=_LARGEST)
    reach = _reach(model, coefficients.detach())
    few = alike(items.shape[-2], max(256, _CACHED // max(1, batch.numel())))
    apart = items.shape[-2] > few and not torch.compiler.is_compiling()
    values, inputs = None, (K, coefficients, reach, items)
    if prepare is not None and known is None and batch.numel() * items.shape[-2] >= MANY:
        values = prepare(model, *inputs)
        apart = apart and (values is None or differentiated(*inputs))
    found, valid = recomputed(
        partial(function, True),
        *inputs,
        values=values or partial(function, False),
        cut=Cut(few, (0, 0, 0, -2), (-2, -1)) if apart else None,
    )
    if known is not None or sound is not None:
        sound = sound if sound is None else sound.unsqueeze(-1)
        found = only(found, known, sound)
        masks = (None if mask is None else mask.squeeze(-1) for mask in (known, sound))
        valid = only(valid, *masks, other=False)
    return found.expand(*batch, *found.shape[-2:]), valid.expand(*batch, valid.shape[-1])


def _rays_of_many(
    model: str, K: Tensor, coefficients: Tensor, reach: Tensor, pixels: Tensor
) -> Callable[..., _Both] | None:
    """The values of :func:`_rays` by what is found once for all pixels of one lens."""
    one = K.numel() == 9 and coefficients.shape[:-1].numel() == 1
    if not one or not all(map(values_at_hand, (K, coefficients, pixels))):
        return None
    K, coefficients = K.detach().reshape(3, 3), coefficients.detach().flatten()
    plain = partial(_rays, model, False, K, coefficients, reach.flatten())
    if not MODELS[model].around_axis:
        return lambda *given: by_chunks(plain, given[-1])
    parts = (_terms(coefficients), reach.flatten(), pixels, plain)
    with outside_gradients():
        found = rays_around_axis(MODELS[model], K, *parts)
    return None if found is None else lambda *given: found(given[-1])


def _terms(coefficients: Tensor) -> Sequence[Tensor]:
    """Coefficients, each ``(*B, 1)``."""
    return coefficients.unsqueeze(-2).unbind(dim=-1) if coefficients.shape[-1] else ()


def _reach(model: str, coefficients: Tensor) -> Tensor:
    measure = MODELS[model].reach
    if measure is None or not MODELS[model].coefficients:
        return coefficients.new_full((1,), torch.pi)
    return measure(_terms(coefficients))


def _pixels(
    model: str, _: bool, K: Tensor, coefficients: Tensor, reach: Tensor, points: Tensor
) -> _Both:
    fx, skew, cx, fy, cy = entries_of(K)
    xyz, finite = finite_or_zero(points.to(K.dtype), limit=_FAR)
    u, v, seen = MODELS[model].pixels(_terms(coefficients), reach, *xyz.unbind(dim=-1))
    x = torch.addcmul(torch.addcmul(cx, fx, u), skew, v)
    y = torch.addcmul(cy, fy, v)
    largest = torch.finfo(points.dtype).max
    valid = seen & (x.abs() < largest) & (y.abs() < largest)
    valid = valid if finite is None else valid & finite.squeeze(-1)
    return _together((x, y), valid, points.dtype), valid


def _rays(
    model: str, derivable: bool, K: Tensor, coefficients: Tensor, reach: Tensor, pixels: Tensor
) -> _Both:
    # Beyond that many px a float64 knows no pixel, nor its square.
    xy, finite = finite_or_zero(pixels.to(K.dtype), limit=_LARGEST)
    fx, skew, cx, fy, cy = entries_of(K)
    x, y = xy.unbind(dim=-1)
    v = (y - cy) / fy
    u = torch.addcmul(x - cx, skew, v, value=-1) / fx
    small = None
    if not (surely_below(u, _LARGEST) and surely_below(v, _LARGEST)):
        small = torch.maximum(u.detach().abs(), v.detach().abs()) < _LARGEST
    u, v, within = only(u, small), only(v, small), None
    terms, undone = _terms(coefficients), MODELS[model].undone
    if undone is not None:
        u, v, within = undone(terms, reach, u, v, derivable)
    *ray, valid = MODELS[model].rays(terms, reach, u, v, derivable)
    finite = finite if finite is None else finite.squeeze(-1)
    valid = only(valid, within, small, finite, other=False)
    return _together(ray, valid, pixels.dtype), valid


def _together(parts: Sequence[Tensor], valid: Tensor, dtype: torch.dtype) -> Tensor:
    """The parts, 0 where not valid, in one tensor."""
    known = unless_all(valid)
    return as_one([only(part, known) for part in parts], dtype)
