"""What is known about given points: residual, parallax, covariance."""

from collections.abc import Sequence

import torch
from torch import Tensor

from deltas_geom.checks import check_tensor
from deltas_geom.numerics.arithmetic import (
    at_least_in_single,
    outside_gradients,
    solver_dtype,
    without_autocast,
)
from deltas_geom.numerics.symmetric3 import inverse3
from deltas_geom.numerics.vectors import Symmetric3, Vector3, matrix3
from deltas_geom.triangulation.dlt import normal_coefficients, normal_matrix
from deltas_geom.triangulation.observed import (
    cameras_of,
    check_observed,
    clean_pixels,
    clean_points,
    finite_cameras,
)
from deltas_geom.triangulation.reprojection import (
    Reprojection,
    mean_of,
    parallax_of,
    reproject,
    squared_errors,
)
from deltas_geom.triangulation.weights import weigh


@without_autocast
def reprojection_residual(
    proj: Tensor, points: Tensor, pixels: Tensor, weights: Tensor, *, mask: Tensor | None = None
) -> Tensor:
    """Weighted RMS distance of projections from pixels, ``(*B, N)`` px.

    Args:
        proj: ``(*B, V, 3, 4)``.
        points: ``(*B, N, 3)``.
        pixels: ``(*B, V, N, 2)``; those of unused views may hold anything.
        weights: ``(*B, V, N)``; views of weight 0, and those behind which a point lies, do not
            count.
        mask: ``(*B, V, N)`` bool, True = used.

    Returns:
        0 where no view counts, or something used is not finite. Many pixels also of pixels handed
        over as (N, V, 2) where N = V.

    Raises:
        ShapeError: a trailing shape differs, batch dims do not broadcast, or there is no view.
        TypeError: ``proj`` is not floating point, or the mask not bool.
    """
    check_tensor(weights=weights)
    batch = check_observed(proj=proj, pixels=pixels, weights=weights, mask=mask, points=points)
    (cameras, broken), (places, known) = finite_cameras(proj), clean_points(points)
    x, y, sound = clean_pixels(pixels)
    healthy = (broken == 0).unsqueeze(-1)
    sound = healthy if sound is None else sound & healthy
    weighed = weigh(weights, mask, batch=batch, like=weights.unsqueeze(-1), sound=sound)
    used = ~weighed.unused & (weighed.sound & known).unsqueeze(-2)
    found = reproject(cameras, places, used)
    residual = mean_of(squared_errors(found, x, y), found.seen, weighed.squared)
    return residual.clamp(max=torch.finfo(proj.dtype).max).to(proj.dtype)


@without_autocast
def ray_parallax(proj: Tensor, points: Tensor, used: Tensor) -> Tensor:
    """Largest angle between the rays of used views at a point, ``(*B, N)`` rad; no gradient.

    Args:
        proj: ``(*B, V, 3, 4)``; cameras of unused views may hold anything.
        points: ``(*B, N, 3)``.
        used: ``(*B, V, N)`` bool. (N, V) goes unnoticed where N = V: with one point left out it is
            an error.

    Returns:
        0 where fewer than two views are used, or the point or a used camera is not finite.

    Raises:
        ShapeError: a trailing shape differs, batch dims do not broadcast, or there is no view.
        TypeError: ``proj`` is not floating point, or ``used`` not bool.
    """
    check_observed(proj=proj, points=points, used=used)
    cameras, (places, known) = cameras_of(proj.detach()), clean_points(points.detach())
    broken = cameras.broken.unsqueeze(-1) > 0
    sound = known & ~(broken & used).any(dim=-2)
    counted = (used & sound.unsqueeze(-2)).to(cameras.proj.dtype)
    return parallax_of(cameras.centers, places, counted).to(proj.dtype)


@at_least_in_single
def point_covariance(
    proj: Tensor,
    points: Tensor,
    weights: Tensor,
    *,
    mask: Tensor | None = None,
    pose_covariance: Tensor | None = None,
) -> Tensor:
    r"""First-order covariance ``(*B, N, 3, 3)`` m^2 for pixel noise of 1 / weight px.

    (sum w^2 J^T J)^-1 with J the derivative of the pixels by the point. Trust it while the
    relative depth error it states is below about 5 %.

    Args:
        proj: ``(*B, V, 3, 4)``.
        points: ``(*B, N, 3)`` in the world, metres. The (0, 0, 0) of a failed triangulation is a
            place like any other, and known well if cameras see it: give such points no weight,
            ``weights * result.valid``, or leave them out, ``mask & result.valid``.
        weights: ``(*B, V, N)``; 0 = unused, as is less than a millionth of the point's largest.
            (N, V) goes unnoticed where N = V: with one point left out it is an error.
        mask: ``(*B, V, N)`` bool, True = used.
        pose_covariance: ``(*B, V, 6, 6)`` of each camera's centre (m) and rotation vector (rad),
            both along the world's axes, independent from view to view; adds what uncertain
            poses do to points that minimise the reprojection error. Taken as
            it is: where it is no covariance (a negative variance), nor is the result.

    Returns:
        0 where fewer than two views see the point, or something used is not finite: nothing is
        stated. A direction in which nothing is known has a large, finite variance. A covariance
        that does not fit the dtype, which is float32 at least, is its largest number times the
        identity. What unused views hold (camera, pose) has no effect.

    Raises:
        ShapeError: a trailing shape differs, batch dims do not broadcast, or there is no view.
        TypeError: ``proj`` is not floating point, or the mask not bool.

    Source: Hartley and Zisserman, 2nd ed., sections 5.2 and 5.2.6 (implicit functions).

    Example:
        >>> from deltas_geom import triangulate
        >>> proj = torch.eye(3, 4).repeat(2, 1, 1)
        >>> proj[1, 0, 3] = -1.0  # 1 m to the right; pixels are slopes
        >>> proj[:, 2, 3] = 1.0  # both 1 m behind the origin
        >>> pixels = torch.tensor([[[0.25, 0.0], [0.1, 0.0]], [[-0.25, 0.0], [0.1, 0.0]]])
        >>> found = triangulate(proj, pixels)  # fails for the second, of parallel rays
        >>> noise = point_covariance(proj, found.points, torch.ones(2, 2) * found.valid)
        >>> noise.diagonal(dim1=-2, dim2=-1).round(decimals=3)
        tensor([[ 2.,  2., 32.],
                [ 0.,  0.,  0.]])
    """
    check_tensor(weights=weights)
    batch = check_observed(
        proj=proj, points=points, weights=weights, mask=mask, pose_covariance=pose_covariance
    )
    (cameras, broken), (places, known) = finite_cameras(proj), clean_points(points)
    work, sound, noise = cameras.dtype, broken == 0, None
    if pose_covariance is not None:
        stated = _fits(pose_covariance.to(work), torch.finfo(work).max ** 0.25)
        noise = torch.where(stated, pose_covariance, 0.0).to(work)
        sound = sound & stated[..., 0, 0]
    like = weights.unsqueeze(-1)
    weighed = weigh(weights, mask, batch=batch, like=like, sound=sound.unsqueeze(-1))
    used = ~weighed.unused & (weighed.sound & known).unsqueeze(-2)
    seen = reproject(cameras, places, used)
    entries = covariance_of(cameras, seen, weighed.squared)
    found, of_pixels = unscaled(entries, weighed.largest.squeeze(-2)), unpacked3(entries)
    if noise is not None:
        # Double where: products of what is as good as infinite would be NaN.
        finite = torch.where(_fits(of_pixels, torch.finfo(work).max ** 0.75), of_pixels, 0.0)
        found = found + _of_poses(cameras, places, seen, weighed.squared, finite, noise)
    return representable(found, proj.dtype)


@at_least_in_single
def depth_variance(proj: Tensor, covariance: Tensor) -> Tensor:
    """Variance ``(*B, V, N)`` m^2 of points' depths in views, from the points' covariance.

    Args:
        proj: ``(*B, V, 3, 4)`` K [R | t] with K[2, 2] = 1.
        covariance: ``(*B, N, 3, 3)`` m^2 in the world.

    Returns:
        In the dtype to which the arguments promote, float32 at least, whose largest number stands
        for more. 0 where the camera or the covariance is not finite.

    Raises:
        ShapeError: a trailing shape differs, batch dims do not broadcast, or there is no view.
        TypeError: an argument is not floating point.

    Example:
        >>> depth_variance(torch.eye(3, 4)[None], torch.diag(torch.tensor([1.0, 2.0, 9.0]))[None])
        tensor([[9.]])
    """
    check_observed(proj=proj, covariance=covariance)
    dtype = torch.promote_types(proj.dtype, covariance.dtype)
    (cameras, _), work = finite_cameras(proj), solver_dtype(proj)
    finite = _fits(covariance, torch.finfo(covariance.dtype).max)
    spread = torch.where(finite, covariance, 0.0).to(work)
    with outside_gradients():
        size = spread.abs().amax(dim=(-2, -1), keepdim=True)
        size = torch.where(size > 0, size, 1.0)
    axis = cameras[..., 2, :3]
    # Of shares of the largest entry, which may be the largest number that there is.
    along = torch.einsum("...vi,...nij->...vnj", axis, spread / size)
    variance = torch.einsum("...vnj,...vj->...vn", along, axis) * size[..., 0].mT
    limit = torch.finfo(dtype).max
    return variance.clamp(-limit, limit).to(dtype)


def representable(covariance: Tensor, dtype: torch.dtype) -> Tensor:
    """Covariances ``(*B, N, 3, 3)`` in a dtype; its largest number times 1 for those beyond it."""
    limit = torch.finfo(dtype).max
    largest = limit * torch.eye(3, dtype=covariance.dtype, device=covariance.device)
    # Whole matrices: with entries cut off one by one they would be no covariances.
    return torch.where(_fits(covariance, limit), covariance, largest).to(dtype)


def _fits(matrices: Tensor, limit: float) -> Tensor:
    """Is every entry of ``(..., K, K)`` finite and at most this large? ``(..., 1, 1)``."""
    within: Tensor = matrices.detach().abs() <= limit  # NaN is not
    return within.all(dim=-1, keepdim=True).all(dim=-2, keepdim=True)


def covariance_of(proj: Tensor, found: Reprojection, squared: Tensor) -> Symmetric3:
    """(sum w^2 J^T J)^-1 of each point, six ``(*B, N)``; 0 below two views.

    The largest number times the identity where the sum is not within the range of numbers.
    """
    return inverse_information(_information(proj, found, squared), found.seen.sum(dim=-2) >= 2)


def _information(proj: Tensor, found: Reprojection, squared: Tensor) -> Symmetric3:
    """sum w^2 J^T J of each point, six ``(*B, N)``."""
    by_depth = torch.where(found.seen, squared, 0.0) * found.inverse * found.inverse
    # The derivative of a pixel by the point is its equations, divided by the depth.
    return normal_matrix(normal_coefficients(proj[..., :3]), found.x, found.y, by_depth)


def inverse_information(normal: Sequence[Tensor], enough: Tensor) -> Symmetric3:
    """Inverses, six ``(*B, N)``; 0 unless ``enough``, and as of :func:`covariance_of`."""
    with outside_gradients():
        trace, limit = normal[0] + normal[3] + normal[5], torch.finfo(normal[0].dtype).max
        ordinary = enough & (trace > limit**-0.45) & (trace < limit**0.45)
        unit = torch.where(ordinary, trace, 1.0)
    # Double where: what has no inverse must pass no gradient and no NaN.
    share = tuple(torch.where(ordinary, entry, 0.0) / unit for entry in normal)
    xx, xy, xz, yy, yz, zz = inverse3(share)
    largest = limit * enough.to(unit.dtype)
    xx, yy, zz = (torch.where(ordinary, entry / unit, largest) for entry in (xx, yy, zz))
    xy, xz, yz = (torch.where(ordinary, entry / unit, 0.0) for entry in (xy, xz, yz))
    return xx, xy, xz, yy, yz, zz


def unpacked3(entries: Sequence[Tensor]) -> Tensor:
    """Symmetric matrices ``(*B, N, 3, 3)`` from six ``(*B, N)``."""
    xx, xy, xz, yy, yz, zz = entries
    # Not an index: it would be copied to the device.
    return matrix3(xx, xy, xz, xy, yy, yz, xz, yz, zz)


def unscaled(entries: Sequence[Tensor], largest: Tensor) -> Tensor:
    """Covariances ``(*B, N, 3, 3)`` from those of weights whose largest, ``(*B, N)``, was 1."""
    unit = largest[..., None, None]
    # Divided twice: the square of a small weight may be 0.
    return unpacked3(entries) / unit / unit


def _of_poses(
    cameras: Tensor,
    points: Vector3,
    found: Reprojection,
    squared: Tensor,
    covariance: Tensor,
    pose_covariance: Tensor,
) -> Tensor:
    """What uncertain poses add to the covariance of points, ``(*B, N, 3, 3)``.

    A camera that is displaced by d and turned by r about its centre c sees a point X where it
    would have seen X - d + (X - c) x r.
    """
    # Each view alone, to keep their information apart: (*B, V, N, 3, 3).
    views = Reprojection(*(of_all.unsqueeze(-2) for of_all in found))
    information = unpacked3(_information(cameras.unsqueeze(-3), views, squared.unsqueeze(-2)))
    ox, oy, oz = (
        component.unsqueeze(-2) - center.unsqueeze(-1)
        for component, center in zip(
            points, cameras_of(cameras).centers.unbind(dim=-1), strict=True
        )
    )  # (*B, V, N)
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
