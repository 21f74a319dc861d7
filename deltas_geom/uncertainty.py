"""What is known about given points: residual, parallax, covariance."""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.checks import check_bool, check_shapes
from deltas_geom.homogeneous import safe_divide, safe_sqrt
from deltas_geom.normal_matrix import Symmetric3, inverse3, normal_matrix
from deltas_geom.observations import Vector3, projection_centers, solver_dtype
from deltas_geom.precision import promoted, without_autocast


@without_autocast
def reprojection_residual(proj: Tensor, points: Tensor, pixels: Tensor, weights: Tensor) -> Tensor:
    """Weighted RMS distance of projections from pixels, ``(*B, N)`` px.

    Args:
        proj: ``(*B, V, 3, 4)``.
        points: ``(*B, N, 3)``.
        pixels: ``(*B, V, N, 2)``, finite.
        weights: ``(*B, V, N)``; views of weight 0, and those behind which a point lies, do not
            count. 0 where no view counts.
    """
    check_shapes(
        proj=(proj, "+V 3 4"),
        points=(points, "N 3"),
        pixels=(pixels, "V N 2"),
        weights=(weights, "V N"),
    )
    work = solver_dtype(proj)
    size = weights.detach().abs().amax(dim=-2, keepdim=True)
    share = weights.to(work) / torch.where(size > 0, size, 1.0)
    x, y, z = points.to(work).unbind(dim=-1)
    seen = reproject(proj.to(work), (x, y, z), weights != 0)
    return residual_of(seen, pixels.to(work).mT, share * share).to(proj.dtype)


@without_autocast
def ray_parallax(proj: Tensor, points: Tensor, used: Tensor) -> Tensor:
    """Largest angle between the rays of used views at a point, ``(*B, N)`` rad.

    Args:
        proj: ``(*B, V, 3, 4)``.
        points: ``(*B, N, 3)``.
        used: ``(*B, V, N)`` bool.
    """
    check_shapes(proj=(proj, "+V 3 4"), points=(points, "N 3"), used=(used, "V N"))
    check_bool(used=used)
    work = solver_dtype(proj)
    centers = projection_centers(proj.detach().to(work))
    x, y, z = points.detach().to(work).unbind(dim=-1)
    return parallax_of(centers, (x, y, z), used.to(work)).to(proj.dtype)


@without_autocast
def point_covariance(
    proj: Tensor, points: Tensor, weights: Tensor, *, pose_covariance: Tensor | None = None
) -> Tensor:
    r"""First-order covariance ``(*B, N, 3, 3)`` m^2 for pixel noise of 1 / weight px.

    (sum w^2 J^T J)^-1 with J the derivative of the pixels by the point. Trust it while the
    relative depth error it states is below about 5 %.

    Args:
        proj: ``(*B, V, 3, 4)``.
        points: ``(*B, N, 3)`` in the world, metres.
        weights: ``(*B, V, N)``; 0 = unused.
        pose_covariance: ``(*B, V, 6, 6)`` of each camera's centre (m) and rotation vector (rad),
            both along the world's axes, independent from view to view; adds what uncertain
            poses do to points that minimise the reprojection error. Taken as
            it is: where it is no covariance (a negative variance), nor is the result.

    Returns:
        0 where fewer than two views see the point. A direction in which nothing is known has a
        large, finite variance.

    Source: Hartley and Zisserman, 2nd ed., sections 5.2 and 5.2.6 (implicit functions).

    Example:
        >>> proj = torch.eye(3, 4).repeat(2, 1, 1)
        >>> proj[1, 0, 3] = -1.0  # 1 m to the right; pixels are slopes
        >>> noise = point_covariance(proj, torch.tensor([[0.5, 0.0, 2.0]]), torch.ones(2, 1))
        >>> noise.diagonal(dim1=-2, dim2=-1)
        tensor([[ 2.,  2., 32.]])
    """
    check_shapes(proj=(proj, "+V 3 4"), points=(points, "N 3"), weights=(weights, "V N"))
    work = solver_dtype(proj)
    camera = proj.to(work)
    x, y, z = points.to(work).unbind(dim=-1)
    seen = reproject(camera, (x, y, z), weights != 0)
    squared = weights.to(work).square()
    found = unpacked3(covariance_of(camera, seen, squared))
    if pose_covariance is not None:
        check_shapes(proj=(proj, "+V 3 4"), pose_covariance=(pose_covariance, "V 6 6"))
        noise = pose_covariance.to(work)
        found = found + _of_poses(camera, points.to(work), seen, squared, found, noise)
    limit = torch.finfo(proj.dtype).max
    return found.to(proj.dtype).nan_to_num(limit).clamp(-limit, limit)


@without_autocast
def depth_variance(proj: Tensor, covariance: Tensor) -> Tensor:
    """Variance ``(*B, V, N)`` m^2 of points' depths in views, from the points' covariance.

    Args:
        proj: ``(*B, V, 3, 4)`` K [R | t] with K[2, 2] = 1.
        covariance: ``(*B, N, 3, 3)`` m^2 in the world.

    Example:
        >>> depth_variance(torch.eye(3, 4)[None], torch.diag(torch.tensor([1.0, 2.0, 9.0]))[None])
        tensor([[9.]])
    """
    check_shapes(proj=(proj, "+V 3 4"), covariance=(covariance, "N 3 3"))
    proj, covariance = promoted(proj, covariance)
    axis = proj[..., 2, :3]
    along = torch.einsum("...vi,...nij->...vnj", axis, covariance)
    return torch.einsum("...vnj,...vj->...vn", along, axis)


class Reprojection(NamedTuple):
    """Points as views see them.

    Attributes:
        x: ``(*B, V, N)`` px; 0 where not seen.
        y: ``(*B, V, N)`` px.
        inverse: ``(*B, V, N)`` 1 / depth; 0 where not seen.
        depth: ``(*B, V, N)``.
        seen: ``(*B, V, N)`` bool, used and in front.
    """

    x: Tensor
    y: Tensor
    inverse: Tensor
    depth: Tensor
    seen: Tensor


def reproject(proj: Tensor, points: Vector3, used: Tensor) -> Reprojection:
    """Project points, three ``(*B, N)``, into the used views ``(*B, V, N)``."""
    x, y, z = (in_views(proj[..., row, :], points) for row in range(3))
    # Far above the smallest number, so that squares of the inverse are finite.
    seen = used & (z.detach() > torch.finfo(z.dtype).tiny ** 0.25)
    inverse = safe_divide(torch.ones_like(z), z, seen)
    return Reprojection(x * inverse, y * inverse, inverse, z, seen)


def in_views(row: Tensor, points: Vector3) -> Tensor:
    """A row ``(*B, V, 4)`` of each camera times points, three ``(*B, N)``: ``(*B, V, N)``."""
    total = row[..., 3:]
    for axis, component in enumerate(points):
        total = torch.addcmul(total, row[..., axis, None], component.unsqueeze(-2))
    return total


def residual_of(found: Reprojection, xy: Tensor, squared: Tensor) -> Tensor:
    """Weighted RMS distance ``(*B, N)`` px from ``xy``: ``(*B, V, 2, N)``."""
    x, y = xy.unbind(dim=-2)
    # Scaled before it is squared: projections may lie anywhere.
    dx, dy = torch.where(found.seen, found.x - x, 0.0), torch.where(found.seen, found.y - y, 0.0)
    squared = torch.where(found.seen, squared, 0.0)
    errors = ((dx * dx + dy * dy) * squared).sum(dim=-2)
    total = squared.sum(dim=-2)
    mean = safe_divide(errors, total, total > 0)
    return safe_sqrt(mean)


@torch.no_grad()
def parallax_of(centers: Tensor, points: Vector3, used: Tensor) -> Tensor:
    """Largest angle ``(*B, N)`` rad between rays from ``(*B, V, 3)`` to the points.

    Args:
        centers: of the cameras.
        points: three ``(*B, N)`` in the same frame.
        used: ``(*B, V, N)`` 1 or 0.
    """
    x, y, z = (
        component.unsqueeze(-2) - center[..., None]
        for component, center in zip(points, centers.unbind(dim=-1), strict=True)
    )  # (*B, V, N)
    tiny = torch.finfo(x.dtype).tiny ** 0.5
    inverse = torch.rsqrt(torch.addcmul(torch.addcmul(x * x, y, y), z, z).clamp(min=tiny))
    x, y, z = x * inverse, y * inverse, z * inverse
    chord = torch.zeros_like(used[..., 0, :])
    for first in range(used.shape[-2] - 1):
        one, rest = slice(first, first + 1), slice(first + 1, None)
        dx, dy, dz = (t[..., one, :] - t[..., rest, :] for t in (x, y, z))
        apart = torch.addcmul(torch.addcmul(dx * dx, dy, dy), dz, dz)
        both = used[..., one, :] * used[..., rest, :]
        chord = torch.maximum(chord, (apart * both).amax(dim=-2))
    # The chord keeps small angles that the arc cosine of a dot product rounds away.
    return 2 * torch.asin((0.5 * chord.sqrt()).clamp(max=1))


def covariance_of(proj: Tensor, found: Reprojection, squared: Tensor) -> Symmetric3:
    """(sum w^2 J^T J)^-1 of each point, six ``(*B, N)``; 0 below two views."""
    by_depth = torch.where(found.seen, squared, 0.0) * found.inverse * found.inverse
    # The derivative of a pixel by the point is its equations, divided by the depth.
    m00, m01, m02, m11, m12, m22 = normal_matrix(proj[..., :3], found.x, found.y, by_depth)
    enough = found.seen.sum(dim=-2) >= 2
    m00, m11, m22 = (torch.where(enough, pivot, 1.0) for pivot in (m00, m11, m22))
    c00, c01, c02, c11, c12, c22 = (
        torch.where(enough, entry, 0.0) for entry in inverse3((m00, m01, m02, m11, m12, m22))
    )
    return c00, c01, c02, c11, c12, c22


def unpacked3(entries: Symmetric3) -> Tensor:
    """Symmetric matrices ``(*B, N, 3, 3)`` from six ``(*B, N)``."""
    xx, xy, xz, yy, yz, zz = entries
    # Not an index, which is copied to the device and waited for.
    return torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], dim=-1).reshape(*xx.shape, 3, 3)


def _of_poses(
    proj: Tensor,
    points: Tensor,
    found: Reprojection,
    squared: Tensor,
    covariance: Tensor,
    pose_covariance: Tensor,
) -> Tensor:
    """What uncertain poses add to the covariance of points, ``(*B, N, 3, 3)``.

    A camera that is displaced by d and turned by r about its centre c sees a point X where it
    would have seen X - d + (X - c) x r.
    """
    by_depth = torch.where(found.seen, squared, 0.0) * found.inverse * found.inverse
    view = proj.unsqueeze(-3)  # each view alone, to keep their information apart
    x, y, w = (tensor.unsqueeze(-2) for tensor in (found.x, found.y, by_depth))
    m00, m01, m02, m11, m12, m22 = normal_matrix(view[..., :3], x, y, w)
    information = unpacked3((m00, m01, m02, m11, m12, m22))  # (*B, V, N, 3, 3)
    offset = points.unsqueeze(-3) - projection_centers(proj).unsqueeze(-2)
    ox, oy, oz = offset.unbind(dim=-1)
    zero, one = torch.zeros_like(ox), torch.ones_like(ox)
    moved = torch.stack(
        [-one, zero, zero, zero, -oz, oy,
         zero, -one, zero, oz, zero, -ox,
         zero, zero, -one, -oy, ox, zero],
        dim=-1,
    ).reshape(*ox.shape, 3, 6)  # fmt: skip
    response = covariance.unsqueeze(-4) @ information @ moved
    spread: Tensor = response @ pose_covariance.unsqueeze(-3) @ response.mT
    return spread.sum(dim=-4)
