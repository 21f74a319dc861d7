"""Weighted, masked n-view DLT triangulation; every point carries a Status.

Each point is solved in its own rig frame: origin at the w^2-weighted mean of the centres of
the cameras that see it, unit their spread. There the algebraic error is nearly the angular
one, the answer does not depend on the world's origin or unit, and a masked view leaves no
trace. Sums and solve run in float64 whatever the input, where the device has it.
"""

from collections.abc import Callable
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from deltas_geom.checks import batch_shape, check_shapes
from deltas_geom.homogeneous import safe_divide, to_homogeneous
from deltas_geom.null_vector import Symmetric4, multiply, null_vector
from deltas_geom.status import Status
from deltas_geom.uncertainty import (
    point_covariance,
    projection_centers,
    ray_parallax,
    reprojection_residual,
    solver_dtype,
)

# A view whose weight is below this share of the point's largest counts as no view: its squared
# weight, times a small parallax, would be lost in the rounding of the normal matrix.
_NEGLIGIBLE_WEIGHT = 1e-6
_CHUNK, _SMALLEST_CHUNK = 8192, 1024  # points
_UPPER = ([0, 0, 0, 0, 1, 1, 1, 2, 2, 3], [0, 1, 2, 3, 1, 2, 3, 2, 3, 3])


class Triangulation(NamedTuple):
    """Triangulated points and what is known about them.

    Attributes:
        points: ``(*B, N, 3)`` in the world, metres; (0, 0, 0) with zero gradient if not valid.
        depth: ``(*B, V, N)`` along each camera's z axis, metres; 0 if not valid.
        status: ``(*B, N)`` int8 of :class:`Status`.
        valid: ``(*B, N)`` bool, status is OK.
        residual: ``(*B, N)`` weighted RMS distance of the projections from the pixels, px.
        parallax: ``(*B, N)`` largest angle between rays of used views, rad.
        covariance: ``(*B, N, 3, 3)`` for pixel noise of standard deviation 1 / weight px, m^2;
            None unless asked for.
    """

    points: Tensor
    depth: Tensor
    status: Tensor
    valid: Tensor
    residual: Tensor
    parallax: Tensor
    covariance: Tensor | None


def triangulate_points(
    proj: Tensor,
    pixels: Tensor,
    weights: Tensor | None = None,
    mask: Tensor | None = None,
    *,
    frame: Literal["rig", "world"] = "rig",
) -> Tensor:
    """Points ``(*B, N, 3)`` alone; see :func:`triangulate`."""

    def solve(chunk: _Chunk) -> tuple[Tensor]:
        observed = _observe(proj, *chunk)
        return (_judge(observed, _solve(observed, frame))[0],)

    return _in_chunks(solve, pixels, weights, mask, dims=(-2,))[0]


def triangulate(
    proj: Tensor,
    pixels: Tensor,
    weights: Tensor | None = None,
    mask: Tensor | None = None,
    *,
    frame: Literal["rig", "world"] = "rig",
    covariance: bool = False,
) -> Triangulation:
    """Triangulate matched pixels of V views by weighted DLT, differentiably.

    Args:
        proj: ``(*B, V, 3, 4)`` K [R | t].
        pixels: ``(*B, V, N, 2)`` matches; those of unused views may hold anything.
        weights: ``(*B, V, N)`` not negative (a sign has no effect: the rows they multiply are
            squared). 0 = unused.
        mask: ``(*B, V, N)`` bool, True = used.
        frame: "rig" solves in each point's rig frame; "world" in the frame of ``proj``, as
            OpenCV and kornia do, whose answer depends on the world's origin and unit.
        covariance: also compute the covariance of the points.

    Returns:
        Points with status. Nothing raises or turns NaN because of values.

    Raises:
        ShapeError: a trailing shape differs.

    Source: Hartley and Zisserman, 2nd ed., section 12.2; weights as in the paper, section
    3.2, after Iskakov et al. (2019).

    Example:
        >>> left = torch.tensor([[100.0, 0, 50, 0], [0, 100, 40, 0], [0, 0, 1, 0]])
        >>> right = left.clone()
        >>> right[0, 3] = -20.0  # 20 cm to the right
        >>> pixels = torch.tensor([[[60.0, 40.0]], [[50.0, 40.0]]])
        >>> result = triangulate(torch.stack([left, right]), pixels)
        >>> result.points.round(decimals=3)
        tensor([[0.2000, 0.0000, 2.0000]])
    """

    def solve(chunk: _Chunk) -> tuple[Tensor, ...]:
        observed = _observe(proj, *chunk)
        points, status = _judge(observed, _solve(observed, frame))
        valid = status == Status.OK
        homogeneous = to_homogeneous(points).unsqueeze(-3) @ observed.proj.mT
        depth = torch.where(valid.unsqueeze(-2), homogeneous[..., 2], 0.0)
        used_weights = torch.where(valid.unsqueeze(-2), observed.weights, 0.0)
        residual = reprojection_residual(observed.proj, points, observed.pixels, used_weights)
        parallax = ray_parallax(observed.proj, points, used_weights > 0)
        found = (points, depth, status, valid, residual, parallax)
        if not covariance:
            return found
        return (*found, point_covariance(observed.proj, points, used_weights))

    dims = (-2, -1, -1, -1, -1, -1, *([-3] if covariance else []))
    found = _in_chunks(solve, pixels, weights, mask, dims=dims)
    points, depth, status, valid, residual, parallax = found[:6]
    uncertainty = found[6] if covariance else None
    return Triangulation(points, depth, status, valid, residual, parallax, uncertainty)


_Chunk = tuple[Tensor, Tensor | None, Tensor | None]
"""Pixels, weights and mask of some of the points."""


def _in_chunks(
    solve: Callable[[_Chunk], tuple[Tensor, ...]],
    pixels: Tensor,
    weights: Tensor | None,
    mask: Tensor | None,
    *,
    dims: tuple[int, ...],
) -> tuple[Tensor, ...]:
    """Solve some points at a time, so that what lies between stays in the cache.

    Args:
        solve: from a chunk to results.
        pixels: ``(*B, V, N, 2)``.
        weights: ``(*B, V, N)`` or None.
        mask: ``(*B, V, N)`` or None.
        dims: along which each result is put together.
    """
    count = pixels.shape[-2]
    chunk = max(_SMALLEST_CHUNK, _CHUNK // max(1, pixels.shape[:-3].numel()))
    if count <= chunk:
        return solve((pixels, weights, mask))
    parts = []
    for first in range(0, count, chunk):
        some = slice(first, first + chunk)
        parts.append(
            solve(
                (
                    pixels[..., some, :],
                    None if weights is None else weights[..., some],
                    None if mask is None else mask[..., some],
                )
            )
        )
    columns = zip(*parts, strict=True)
    return tuple(torch.cat(column, dim=dim) for dim, column in zip(dims, columns, strict=True))


class _Observations(NamedTuple):
    """The inputs, broadcast, with everything unusable replaced and flagged.

    Attributes:
        proj: ``(*B, V, 3, 4)`` finite.
        pixels: ``(*B, V, N, 2)`` finite.
        weights: ``(*B, V, N)`` finite; 0 for unused views and unsolvable points.
        largest: ``(*B, 1, N)`` largest weight of each point.
        counts: ``(*B, V, N)`` the view's weight is not negligible beside the largest.
        finite: ``(*B, N)`` everything used is finite.
        enough: ``(*B, N)`` at least two views count.
    """

    proj: Tensor
    pixels: Tensor
    weights: Tensor
    largest: Tensor
    counts: Tensor
    finite: Tensor
    enough: Tensor


def _observe(
    proj: Tensor, pixels: Tensor, weights: Tensor | None, mask: Tensor | None
) -> _Observations:
    check_shapes(proj=(proj, "V 3 4"), pixels=(pixels, "V N 2"))
    weight = torch.ones_like(pixels[..., 0])
    if weights is not None:
        check_shapes(weights=(weights, "V N"), pixels=(pixels, "V N 2"))
        weight = weight * weights
    if mask is not None:
        check_shapes(mask=(mask, "V N"), pixels=(pixels, "V N 2"))
        weight = torch.where(mask, weight, 0.0)
    batch = batch_shape(proj.shape[:-3], weight.shape[:-2])
    weight = weight.expand(*batch, *weight.shape[-2:])
    pixels = pixels.expand(*weight.shape, 2)

    used = weight != 0  # NaN counts as used, and is caught as not finite
    finite_proj = proj.isfinite().all(-1).all(-1)[..., None]
    finite = ((pixels.isfinite().all(dim=-1) & weight.isfinite() & finite_proj) | ~used).all(-2)
    largest = torch.where(used, weight.detach().abs(), 0.0).amax(dim=-2, keepdim=True)
    counts = used & (weight.detach().abs() > _NEGLIGIBLE_WEIGHT * largest)
    enough = counts.sum(dim=-2) >= 2
    solvable = (finite & enough).unsqueeze(-2) & used
    # Double where throughout: what is not used must pass no gradient and no NaN.
    return _Observations(
        proj=torch.where(finite_proj[..., None], proj, 0.0),
        pixels=torch.where(solvable[..., None], pixels, 0.0),
        weights=torch.where(solvable, weight, 0.0),
        largest=torch.where(largest > 0, largest, 1.0),
        counts=counts,
        finite=finite,
        enough=enough,
    )


class _Solution(NamedTuple):
    """Points ``(*B, N, 3)`` before they are judged, and what is known of each ``(*B, N)``."""

    points: Tensor
    posed: Tensor
    at_infinity: Tensor


def _solve(observed: _Observations, frame: str) -> _Solution:
    """Minimise the weighted algebraic error in float64, in the frame asked for.

    Per-point vectors are ``(*B, 3, N)`` here: sums over a leading dim of three run over memory
    in order, sums over a trailing one do not.
    """
    if frame not in ("rig", "world"):
        raise ValueError(f"frame must be 'rig' or 'world', got {frame!r}")
    work = solver_dtype(observed.proj)
    proj = observed.proj.to(work)
    # The scale of all weights cancels; without it their squares cannot underflow.
    squared = (observed.weights.to(work) / observed.largest).square()

    centers, _ = projection_centers(proj)
    origin, unit = _shared_frame(centers.detach(), (observed.weights != 0).any(dim=-1))
    moved = proj[..., 3:] + proj[..., :3] @ origin.unsqueeze(-2).mT
    directions = proj[..., :3].expand(*moved.shape[:-1], 3)
    shared = torch.cat([directions, moved / unit[..., None, None]], dim=-1)
    normal = _normal_matrix(shared, observed.pixels.to(work), squared)
    point = _point_frame((centers - origin) / unit[..., None], squared, observed.counts)
    if frame == "rig":
        normal = _change_frame(normal, point.origin, point.unit)
    else:
        normal = _change_frame(normal, (-origin / unit).mT, 1 / unit)

    # Centres closer together than the rounding of where they are do not differ.
    eps = torch.finfo(observed.proj.dtype).eps
    baseline = point.reach * unit
    from_world = centers.detach().norm(dim=-1)[..., None]
    from_world = torch.where(observed.counts, from_world, 0.0).amax(dim=-2)
    posed = observed.finite & observed.enough & (baseline > 64 * eps * from_world)
    matrix, scalable = _made_safe(normal, posed)
    (x0, x1, x2, x3), simple = null_vector(matrix)
    posed = posed & scalable & simple

    # Far above the smallest number, so that the gradient of the division is finite.
    divisible = x3 > torch.finfo(work).tiny ** (1 / 3)
    inverse = safe_divide(torch.ones_like(x3), x3, posed & divisible)
    points = torch.stack([x0, x1, x2], dim=-2) * inverse.unsqueeze(-2)
    if frame == "rig":
        distance = _length(points.detach()) * point.unit.detach() * unit
        points = (points * point.unit.unsqueeze(-2) + point.origin) * unit[..., None] + origin.mT
    else:
        rig_center = point.origin.detach() * unit[..., None] + origin.mT
        distance = _length(points.detach() - rig_center)
    at_infinity = ~divisible | (16 * eps * distance > baseline)
    points = torch.where((posed & ~at_infinity).unsqueeze(-2), points, 0.0)
    return _Solution(points.mT, posed, at_infinity)


def _length(vectors: Tensor) -> Tensor:
    """``(*B, N)`` lengths of ``(*B, 3, N)``."""
    return vectors.square().sum(dim=-2).sqrt()


def _judge(observed: _Observations, solution: _Solution) -> tuple[Tensor, Tensor]:
    """Points ``(*B, N, 3)`` of the inputs' dtype, 0 where they fail, and status ``(*B, N)``."""
    found = solution.points.detach()
    # A projection matrix is K [R | t] with K[2, 2] = 1: its third row gives metric depth.
    wide_proj = observed.proj.detach().to(found.dtype)
    depth = (to_homogeneous(found).unsqueeze(-3) @ wide_proj.mT)[..., 2]
    in_front = ((depth > 0) | (observed.weights == 0)).all(dim=-2)
    size = torch.maximum(found.abs().amax(dim=-1), depth.abs().amax(dim=-2))
    too_far = solution.at_infinity | (size >= torch.finfo(observed.proj.dtype).max)
    ok = solution.posed & ~too_far & in_front
    status = torch.full_like(observed.enough, Status.OK, dtype=torch.int8)
    for failed, reason in (
        (~in_front, Status.BEHIND_CAMERA),
        (too_far, Status.AT_INFINITY),
        (~solution.posed, Status.NO_PARALLAX),
        (~observed.enough, Status.TOO_FEW_VIEWS),
        (~observed.finite, Status.NOT_FINITE_INPUT),
    ):
        status = torch.where(failed, torch.full_like(status, reason), status)
    return torch.where(ok[..., None], solution.points, 0.0).to(observed.proj.dtype), status


def _shared_frame(centers: Tensor, used: Tensor) -> tuple[Tensor, Tensor]:
    """Mean ``(*B, 1, 3)`` and spread ``(*B, 1)`` of the centres of views used by any point."""
    count = used.sum(dim=-1, keepdim=True).clamp(min=1)
    origin = torch.where(used[..., None], centers, 0.0).sum(dim=-2) / count
    squared = (centers - origin.unsqueeze(-2)).square().sum(dim=-1)
    spread = (torch.where(used, squared, 0.0).sum(dim=-1, keepdim=True) / count).sqrt()
    return origin.unsqueeze(-2), torch.where(spread > 0, spread, 1.0)


def _normal_matrix(proj: Tensor, xy: Tensor, squared: Tensor) -> Symmetric4:
    """A^T W^2 A of the DLT rows x p3 - p1, y p3 - p2, as ten ``(*B, N)``.

    Every entry is linear in (x^2 + y^2, x, y, 1), so all points cost one matrix product.
    """
    p1, p2, p3 = proj.unbind(dim=-2)
    rows, columns = _UPPER

    def outer(a: Tensor, b: Tensor) -> Tensor:
        return (a[..., rows] * b[..., columns] + b[..., rows] * a[..., columns]) / 2

    coefficients = torch.stack(
        [outer(p3, p3), -2 * outer(p3, p1), -2 * outer(p3, p2), outer(p1, p1) + outer(p2, p2)],
        dim=-2,
    )  # (*B, V, 4, 10)
    x, y = xy.unbind(dim=-1)
    terms = torch.stack([(x * x + y * y) * squared, x * squared, y * squared, squared], dim=-2)
    entries = coefficients.flatten(-3, -2).mT @ terms.flatten(-3, -2)
    m00, m01, m02, m03, m11, m12, m13, m22, m23, m33 = entries.unbind(dim=-2)
    return m00, m01, m02, m03, m11, m12, m13, m22, m23, m33


class _PointFrame(NamedTuple):
    """Each point's rig frame, in the shared one.

    Attributes:
        origin: ``(*B, 3, N)`` mean of the centres, weighted by the squared weights.
        unit: ``(*B, N)`` their spread.
        reach: ``(*B, N)`` largest distance of a centre that counts from the origin.
    """

    origin: Tensor
    unit: Tensor
    reach: Tensor


def _point_frame(centers: Tensor, squared: Tensor, counts: Tensor) -> _PointFrame:
    total = squared.sum(dim=-2)
    share = safe_divide(squared, total.unsqueeze(-2), (total > 0).unsqueeze(-2))
    origin = centers.mT @ share
    apart = (centers[..., None] - origin.unsqueeze(-3)).square().sum(dim=-2)  # (*B, V, N)
    variance = (share * apart).sum(dim=-2)
    unit = torch.where(variance > torch.finfo(variance.dtype).tiny, variance, 1.0).sqrt()
    reach = torch.where(counts, apart.detach(), 0.0).amax(dim=-2).sqrt()
    return _PointFrame(origin, unit, reach)


def _change_frame(normal: Symmetric4, origin: Tensor, unit: Tensor) -> Symmetric4:
    """T^T M T for points x = unit x' + origin."""
    m00, m01, m02, _, m11, m12, _, m22, _, _ = normal
    o0, o1, o2 = (component.expand_as(m00) for component in origin.unbind(dim=-2))
    one = torch.ones_like(o0)
    n03, n13, n23, n33 = multiply(normal, (o0, o1, o2, one))
    last = o0 * n03 + o1 * n13 + o2 * n23 + n33
    u, u2 = unit, unit * unit
    return (
        m00 * u2, m01 * u2, m02 * u2, n03 * u,
        m11 * u2, m12 * u2, n13 * u,
        m22 * u2, n23 * u,
        last,
    )  # fmt: skip


def _made_safe(normal: Symmetric4, posed: Tensor) -> tuple[Symmetric4, Tensor]:
    """Scaled to trace 1, and whether it can be; if not, a constant with an easy null vector."""
    trace = (normal[0] + normal[4] + normal[7] + normal[9]).detach()
    usable = posed & (trace > 0) & trace.isfinite()
    scale = torch.where(usable, trace, 1.0)
    easy = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.1)
    m00, m01, m02, m03, m11, m12, m13, m22, m23, m33 = (
        torch.where(usable, entry / scale, constant)
        for entry, constant in zip(normal, easy, strict=True)
    )
    return (m00, m01, m02, m03, m11, m12, m13, m22, m23, m33), usable
