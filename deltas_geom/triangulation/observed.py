"""Cameras and what they see of points, in the solver's type, cleaned and flagged.

Everything downstream may multiply and divide without asking: what is not used is 0 here, and
passes no NaN and no gradient.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import safe_divide
from deltas_geom.checks import check_batch
from deltas_geom.numerics.arithmetic import (
    outside_gradients,
    solver_dtype,
    surely_all,
    values_at_hand,
)
from deltas_geom.numerics.sums import plain, product
from deltas_geom.numerics.vectors import Vector3
from deltas_geom.triangulation.weights import Weights, weigh, weigh_at_hand

_DIMS = {
    "proj": "+V 3 4",
    "cam_from_world": "+V 4 4",
    "pixels": "V N 2",
    "rays": "V N 3",
    "points": "N 3",
    "weights": "V N",
    "mask": "V N",
    "used": "V N",
    "covariance": "N 3 3",
    "pose_covariance": "V 6 6",
}


class Cameras(NamedTuple):
    """Cameras in the solver's type.

    Attributes:
        proj: ``(*B, V, 3, 4)``, 0 for cameras that are not finite.
        broken: ``(*B, V)`` 1 for those, else 0.
        inverse: ``(*B, V, 3, 3)`` of the first columns; 0 where there is none.
        centers: ``(*B, V, 3)``; 0 with zero gradient where there is no inverse.
    """

    proj: Tensor
    broken: Tensor
    inverse: Tensor
    centers: Tensor


def cameras_of(proj: Tensor) -> Cameras:
    """Cameras ``(*B, V, 3, 4)`` with their centres.

    Source: Hartley and Zisserman, 2nd ed., section 6.2.4.
    """
    clean, broken = finite_cameras(proj)
    inverse = _inverses(clean[..., :3])
    return Cameras(clean, broken, inverse, -(inverse * clean[..., 3:].mT).sum(dim=-1))


def finite_cameras(proj: Tensor) -> tuple[Tensor, Tensor]:
    """Tell finite cameras ``(*B, V, 3, 4)`` from others: the first fields of :class:`Cameras`."""
    work = solver_dtype(proj)
    clean = proj.to(work)
    finite = clean.detach().abs().amax(dim=(-2, -1)) < farthest(work)  # NaN is not below
    if not surely_all(finite):
        # Double where: what is not used must pass no gradient and no NaN.
        clean = torch.where(finite[..., None, None], clean, 0.0)
    return clean, (~finite).to(work)


class Observations(NamedTuple):
    """Pixels of N points in V views.

    Attributes:
        x, y: ``(*B, V, N)`` px, 0 where not finite.
        weights: of the pixels.
    """

    x: Tensor
    y: Tensor
    weights: Weights


def observe(
    pixels: Tensor, weights: Tensor | None, mask: Tensor | None, batch: torch.Size
) -> Observations:
    """Pixels ``(*B, V, N, 2)`` broadcast to a batch, with weights and mask as of :func:`weigh`."""
    if pixels.numel() and batch.numel() and plain(pixels, weights, mask):
        return _observe_at_hand(pixels, weights, mask, batch)
    x, y, sound = clean_pixels(pixels)
    return Observations(x, y, weigh(weights, mask, batch=batch, like=pixels, sound=sound))


def _observe_at_hand(
    pixels: Tensor, weights: Tensor | None, mask: Tensor | None, batch: torch.Size
) -> Observations:
    weight, used = (t if t is None else t.detach().numpy() for t in (weights, mask))
    # Struct of arrays: sums over views then run over memory in order.
    seen = np.moveaxis(pixels.detach().numpy(), -1, 0).astype(np.float64, order="C")
    ones = np.ones((*batch, pixels.shape[-3], 1))
    with np.errstate(all="ignore"):
        found = weigh_at_hand(seen, weight, used, ones, coordinates=0, views=-2)
        squared = found.share * found.share
    known = (found.largest, ~found.used, found.used.astype(np.float64), found.sound)
    x, y, squares, *others = map(torch.from_numpy, (*found.pixels, squared, *known))
    return Observations(x, y, Weights(squares, *others))


def clean_pixels(pixels: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
    """x and y of pixels ``(*B, V, N, 2)``, 0 where not finite, and which are finite.

    Each ``(*B, V, N)``, in the solver's type; instead of the last, None where all are known to be.
    """
    # Struct of arrays: sums over views then run over memory in order.
    work = solver_dtype(pixels)
    x, y = (one.to(work, memory_format=torch.contiguous_format) for one in pixels.unbind(dim=-1))
    limit = torch.finfo(work).max ** 0.125  # squares of what is beyond overflow
    if values_at_hand(pixels) and pixels.numel():
        known = [float(end) for one in (x, y) for end in torch.aminmax(one.detach())]
        if all(-limit < end < limit for end in known):  # NaN is not
            return x.contiguous(), y.contiguous(), None
    sound = torch.maximum(x.detach().abs(), y.detach().abs()) < limit  # NaN is not below
    # Double where: what is not used must pass no gradient and no NaN.
    return torch.where(sound, x, 0.0), torch.where(sound, y, 0.0), sound


def clean_points(points: Tensor) -> tuple[Vector3, Tensor]:
    """Points ``(*B, N, 3)`` in the solver's type, 0 where not finite; ``(*B, N)`` are they?"""
    place = points.mT.to(solver_dtype(points)).contiguous()
    finite = place.detach().abs().amax(dim=-2) < farthest(place.dtype)  # NaN is not below
    # Double where: what is not used must pass no gradient and no NaN.
    return torch.where(finite.unsqueeze(-2), place, 0.0).unbind(dim=-2), finite


def farthest(work: torch.dtype) -> float:
    """A coordinate so large that products of four overflow."""
    return float(torch.finfo(work).max ** 0.25)


def check_observed(**named: Tensor | None) -> torch.Size:
    """The batch dims to which arguments of these names broadcast, None being left out.

    Raise as :func:`check_batch` unless each has the dims of its name, and all fit each other.
    """
    return check_batch(**{name: (tensor, _DIMS[name]) for name, tensor in named.items()})


def _inverses(matrix: Tensor) -> Tensor:
    """Of ``(*B, 3, 3)``; 0 with zero gradient if singular within rounding."""
    cofactors = torch.linalg.cross(matrix.roll(-1, dims=-2), matrix.roll(-2, dims=-2))
    determinant = (matrix[..., 0, :] * cofactors[..., 0, :]).sum(dim=-1)[..., None, None]
    with outside_gradients():
        product = torch.linalg.vector_norm(matrix, dim=-1).prod(dim=-1)[..., None, None]
        size, limits = determinant.abs(), torch.finfo(matrix.dtype)
        # The square of the determinant, in the gradient, has to be representable.
        regular = (size > limits.tiny**0.4) & (size < limits.max**0.4)
        regular = regular & (size > 4 * limits.eps * product)
    return safe_divide(cofactors.mT, determinant, regular)


def homogeneous_in_views(proj: Tensor, places: Sequence[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """P X of cameras ``(*B, V, 3, 4)`` and homogeneous points four ``(*B, N)``.

    Three ``(*B, V, N)``.
    """
    if torch.compiler.is_compiling():
        # Row by row, which a compiler fuses with what stands around it.
        a, b, c = (in_views(row, *places) for row in proj.unbind(dim=-2))
        return a, b, c
    rows = proj.transpose(-3, -2).flatten(-3, -2)  # all of p1, all of p2, all of p3
    a, b, c = product(rows, torch.stack(tuple(places), dim=-2)).chunk(3, dim=-2)
    return a, b, c


def in_views(row: Tensor, x: Tensor, y: Tensor, z: Tensor, w: Tensor | None = None) -> Tensor:
    """A row ``(*B, V, 4)`` of each camera times points, each ``(*B, N)``: ``(*B, V, N)``."""
    total = row[..., 3:] if w is None else row[..., 3:] * w.unsqueeze(-2)
    for axis, component in enumerate((x, y, z)):
        total = torch.addcmul(total, row[..., axis, None], component.unsqueeze(-2))
    return total
