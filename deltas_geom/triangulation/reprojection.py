"""Points as views see them again: projections, distances from pixels, angles between rays."""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import safe_divide, safe_sqrt
from deltas_geom.numerics.arithmetic import (
    only,
    outside_gradients,
    surely_all,
    unless_all,
    without_gradients,
)
from deltas_geom.numerics.vectors import Vector3
from deltas_geom.triangulation.observed import homogeneous_in_views


class Reprojection(NamedTuple):
    """Points as views see them.

    Attributes:
        x, y: ``(*B, V, N)`` px; 0 where not seen.
        inverse: ``(*B, V, N)`` 1 / depth; 0 where not seen.
        depth: ``(*B, V, N)``.
        seen: ``(*B, V, N)`` bool, used, in front and not infinitely far to the side.
    """

    x: Tensor
    y: Tensor
    inverse: Tensor
    depth: Tensor
    seen: Tensor


def reproject(proj: Tensor, points: Vector3, used: Tensor) -> Reprojection:
    """Project finite points, three ``(*B, N)``, into the used views ``(*B, V, N)``."""
    return projected(*homogeneous_in_views(proj, (*points, torch.ones_like(points[0]))), used)


def projected(x: Tensor, y: Tensor, z: Tensor, used: Tensor) -> Reprojection:
    """The same of homogeneous pixels."""
    info = torch.finfo(z.dtype)
    with outside_gradients():
        # Far above the smallest number, so that squares of the inverse are finite.
        seen = used & (z > info.tiny**0.25)
        # Projections so far out that products of their squares overflow are beside the camera.
        seen = seen & (torch.maximum(x.abs(), y.abs()) < info.max**0.2 * z)
    inverse = z.reciprocal() if surely_all(seen) else safe_divide(torch.ones_like(z), z, seen)
    return Reprojection(x * inverse, y * inverse, inverse, z, seen)


def squared_errors(found: Reprojection, x: Tensor, y: Tensor) -> Tensor:
    """Squared distances ``(*B, V, N)`` px^2 from pixels, x and y ``(*B, V, N)``; 0 if not seen."""
    known = unless_all(found.seen)
    dx, dy = only(found.x - x, known), only(found.y - y, known)
    return torch.addcmul(dx * dx, dy, dy)


def mean_of(errors: Tensor, seen: Tensor, squared: Tensor) -> Tensor:
    """Weighted RMS ``(*B, N)`` of squared errors ``(*B, V, N)``, with squared weights."""
    squared = only(squared, unless_all(seen))
    sums, total = (errors * squared).sum(dim=-2), squared.sum(dim=-2)
    return safe_sqrt(safe_divide(sums, total, total > 0))


@without_gradients
def parallax_of(centers: Tensor, points: Vector3, used: Tensor) -> Tensor:
    """Largest angle ``(*B, N)`` rad between used rays from ``(*B, V, 3)`` to the points, in one
    frame; ``used`` is 1 or 0.
    """
    x, y, z = (
        component.unsqueeze(-2) - center[..., None]
        for component, center in zip(points, centers.unbind(dim=-1), strict=True)
    )  # (*B, V, N)
    tiny = torch.finfo(x.dtype).tiny ** 0.5
    inverse = torch.rsqrt(torch.addcmul(torch.addcmul(x * x, y, y), z, z).clamp(min=tiny))
    x, y, z = x * inverse, y * inverse, z * inverse
    chord = torch.zeros_like(x[..., 0, :] * used[..., 0, :])
    everywhere = surely_all(used > 0)
    for first in range(x.shape[-2] - 1):
        one, rest = slice(first, first + 1), slice(first + 1, None)
        dx, dy, dz = (t[..., one, :] - t[..., rest, :] for t in (x, y, z))
        apart = torch.addcmul(torch.addcmul(dx * dx, dy, dy), dz, dz)
        if not everywhere:
            apart = apart * (used[..., one, :] * used[..., rest, :])
        chord = torch.maximum(chord, apart.amax(dim=-2))
    return angle_of(chord)


def angle_of(chord: Tensor) -> Tensor:
    """Angle, rad, between unit vectors whose squared difference this is.

    It keeps small angles, which the arc cosine of a dot product rounds away.
    """
    square = (0.25 * chord).clamp(max=1)
    return 2 * torch.atan2(safe_sqrt(square), safe_sqrt(1 - square))
