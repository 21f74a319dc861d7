"""Gauss-Newton on the reprojection error of given points, with robust losses.

A step is the normal matrix of triangulation at the projected pixels and a 3x3 solve. From the
triangulated points of the rig frame one step is enough for all but gross outliers.
"""

from typing import Literal, NamedTuple

import torch
from torch import Tensor

from deltas_geom.checks import batch_shape, check_shapes
from deltas_geom.homogeneous import safe_divide
from deltas_geom.observations import solver_dtype

Loss = Literal["squared", "huber", "cauchy"]

_CHUNK, _SMALLEST_CHUNK = 8192, 1024  # points: what lies between stays in the cache
_FARTHEST = 1e10  # px: a projection farther out than this is as good as behind the camera
_UPPER = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])


class Refined(NamedTuple):
    """Refined points.

    Attributes:
        points: ``(*B, N, 3)`` in the world, metres. What is not valid is returned as it came
            (0 where it was not finite), with zero gradient.
        residual: ``(*B, N)`` weighted RMS distance of the projections from the pixels, px,
            whatever the loss; 0 if not valid.
        valid: ``(*B, N)`` bool: everything used is finite, two or more views are used, the point
            came in front of all of them, and they determine it.
    """

    points: Tensor
    residual: Tensor
    valid: Tensor


def refine_points(
    proj: Tensor,
    pixels: Tensor,
    points: Tensor,
    weights: Tensor | None = None,
    mask: Tensor | None = None,
    *,
    steps: int = 1,
    loss: Loss = "squared",
    scale: float = 1.0,
) -> Refined:
    r"""Move points so that their projections come closer to the pixels.

    Gauss-Newton on :math:`\sum_v w_v^2 \rho(\|e_v\|^2)`, e the distance in pixels. A robust loss
    re-weights the views at each step (iteratively re-weighted least squares). A step is taken
    only where this cost does not grow by more than rounding and the point stays in front of all
    used views; elsewhere the point is kept. Gradients are those of the steps, unrolled; they
    also reach the ``points`` given.

    Args:
        proj: ``(*B, V, 3, 4)`` K [R | t].
        pixels: ``(*B, V, N, 2)`` matches; those of unused views may hold anything.
        points: ``(*B, N, 3)`` in the world, metres: where to start.
        weights: ``(*B, V, N)`` not negative (a sign has no effect). 0 = unused. Only their
            ratios count.
        mask: ``(*B, V, N)`` bool, True = used.
        steps: of Gauss-Newton. 0 judges the points without moving them.
        loss: "squared", "huber" (linear beyond ``scale``) or "cauchy" (logarithmic).
        scale: px, the distance of a view at which a robust loss begins to doubt it.

    Returns:
        Points, residual and whether they could be refined. Nothing raises or turns NaN because
        of values.

    Raises:
        ShapeError: a trailing shape differs.
        ValueError: an unknown loss, a negative number of steps, a scale that is not positive.

    Source: Hartley and Zisserman, 2nd ed., appendix 6; Triggs et al., Bundle Adjustment: A
    Modern Synthesis (2000), section 4.3.

    Example:
        >>> left = torch.tensor([[100.0, 0, 50, 0], [0, 100, 40, 0], [0, 0, 1, 0]])
        >>> right = left.clone()
        >>> right[0, 3] = -20.0  # 20 cm to the right
        >>> pixels = torch.tensor([[[60.0, 45.0]], [[50.0, 45.0]]])
        >>> near = torch.tensor([[0.21, 0.11, 2.1]])
        >>> refined = refine_points(torch.stack([left, right]), pixels, near, steps=3)
        >>> refined.points.round(decimals=3)
        tensor([[0.2000, 0.1000, 2.0000]])
    """
    check_shapes(proj=(proj, "V 3 4"), pixels=(pixels, "V N 2"), points=(points, "N 3"))
    if weights is not None:
        check_shapes(weights=(weights, "V N"), pixels=(pixels, "V N 2"))
    if mask is not None:
        check_shapes(mask=(mask, "V N"), pixels=(pixels, "V N 2"))
    if loss not in ("squared", "huber", "cauchy"):
        raise ValueError(f"loss must be 'squared', 'huber' or 'cauchy', got {loss!r}")
    if steps < 0:
        raise ValueError(f"steps must not be negative, got {steps}")
    if not scale > 0:
        raise ValueError(f"scale must be positive, got {scale}")

    count = pixels.shape[-2]
    chunk = max(_SMALLEST_CHUNK, _CHUNK // max(1, pixels.shape[:-3].numel()))
    parts = []
    for first in range(0, max(count, 1), chunk):
        some = slice(first, first + chunk)
        observed = _observe(
            proj,
            pixels[..., some, :],
            points[..., some, :],
            None if weights is None else weights[..., some],
            None if mask is None else mask[..., some],
        )
        parts.append(_refine(observed, points[..., some, :], steps, loss, scale))
    if len(parts) == 1:
        return parts[0]
    found, residual, valid = zip(*parts, strict=True)
    return Refined(torch.cat(found, dim=-2), torch.cat(residual, dim=-1), torch.cat(valid, dim=-1))


class _Observations(NamedTuple):
    """The inputs in the solver's type, broadcast, with everything unusable replaced.

    Attributes:
        directions: ``(*B, V, 3, 3)`` left part of the cameras.
        positions: ``(*B, V, 3, 1)`` their last column.
        x: ``(*B, V, N)`` px, 0 where unused.
        y: ``(*B, V, N)``.
        points: ``(*B, 3, N)``, 0 where not finite.
        squared: ``(*B, V, N)`` squared weights, largest 1; 0 where unused.
        used: ``(*B, V, N)`` of points that can be refined.
        valid: ``(*B, N)`` finite and two or more views are used.
    """

    directions: Tensor
    positions: Tensor
    x: Tensor
    y: Tensor
    points: Tensor
    squared: Tensor
    used: Tensor
    valid: Tensor


def _observe(
    proj: Tensor, pixels: Tensor, points: Tensor, weights: Tensor | None, mask: Tensor | None
) -> _Observations:
    work = solver_dtype(proj)
    weight = torch.ones_like(pixels[..., 0]) if weights is None else weights
    if mask is not None:
        weight = torch.where(mask, weight, 0.0)
    batch = batch_shape(proj.shape[:-3], pixels.shape[:-3], points.shape[:-2], weight.shape[:-2])
    weight = weight.to(work).expand(*batch, *weight.shape[-2:])
    camera, x, y = proj.to(work), *pixels.to(work).unbind(dim=-1)
    start = points.to(work).mT.expand(*batch, 3, points.shape[-2])

    # NaN is not let through either.
    limit = _limit(proj.dtype, work)
    known_camera = (camera.abs() < limit).all(-1).all(-1)[..., None]
    used = weight != 0  # NaN counts as used, and is caught as not finite
    known = (x.abs() < limit) & (y.abs() < limit) & weight.isfinite() & known_camera
    known_start = (start.abs() < limit).all(dim=-2)
    valid = (known | ~used).all(dim=-2) & known_start & (used.sum(dim=-2) >= 2)
    used = used & valid.unsqueeze(-2)
    largest = torch.where(used, weight.detach().abs(), 0.0).amax(dim=-2, keepdim=True)
    share = weight / torch.where(largest > 0, largest, 1.0)
    # Double where throughout: what is not used must pass no gradient and no NaN.
    camera = torch.where(known_camera[..., None], camera, 0.0)
    return _Observations(
        directions=camera[..., :3],
        positions=camera[..., 3:],
        x=torch.where(used, x, 0.0),
        y=torch.where(used, y, 0.0),
        points=torch.where(known_start.unsqueeze(-2), start, 0.0),
        squared=torch.where(used, share, 0.0).square(),
        used=used,
        valid=valid,
    )


def _limit(given: torch.dtype, work: torch.dtype) -> float:
    """What is beyond counts as not finite: products of four, or a sum of two, overflow."""
    widest: float = torch.finfo(work).max ** 0.25
    return min(widest, torch.finfo(given).max / 4)


class _Fit(NamedTuple):
    """Points and how they fit.

    Attributes:
        points: ``(*B, 3, N)``.
        x: ``(*B, V, N)`` projection, px; 0 where unused.
        y: ``(*B, V, N)``.
        inverse: ``(*B, V, N)`` 1 / depth; 0 where unused.
        distance: ``(*B, V, N)`` squared distance from the pixels, px^2.
        cost: ``(*B, N)`` weighted sum of the loss, without gradient.
        in_front: ``(*B, N)`` of all used views.
    """

    points: Tensor
    x: Tensor
    y: Tensor
    inverse: Tensor
    distance: Tensor
    cost: Tensor
    in_front: Tensor


def _fit(observed: _Observations, points: Tensor, loss: Loss, scale: float) -> _Fit:
    homogeneous = observed.directions @ points.unsqueeze(-3) + observed.positions
    x, y, z = homogeneous.unbind(dim=-2)
    smallest = torch.finfo(z.dtype).tiny ** 0.25
    with torch.no_grad():
        farthest = torch.maximum(x.abs(), y.abs())
        seen = (z > smallest) & (farthest < _FARTHEST * z)
        in_front = (seen | ~observed.used).all(dim=-2)
    inverse = safe_divide(torch.ones_like(z), z, observed.used & seen)
    x, y = x * inverse, y * inverse
    distance = (x - observed.x).square() + (y - observed.y).square()
    with torch.no_grad():
        cost = (observed.squared * _loss(distance, loss, scale)).sum(dim=-2)
    return _Fit(points, x, y, inverse, distance, cost, in_front)


def _loss(distance: Tensor, loss: Loss, scale: float) -> Tensor:
    """The loss of squared distances, px^2; near 0 it is the squared distance itself."""
    if loss == "squared":
        return distance
    ratio = distance / scale**2
    if loss == "cauchy":
        return scale**2 * ratio.log1p()
    return scale**2 * torch.where(ratio > 1, 2 * ratio.sqrt() - 1, ratio)


def _influence(distance: Tensor, loss: Loss, scale: float) -> Tensor:
    """Derivative of the loss by the squared distance: the factor on a view's squared weight."""
    if loss == "squared":
        return torch.ones_like(distance)
    ratio = distance / scale**2
    if loss == "cauchy":
        return 1 / (1 + ratio)
    far = ratio > 1
    return torch.where(far, torch.where(far, ratio, 1.0).rsqrt(), 1.0)


def _refine(
    observed: _Observations, given: Tensor, steps: int, loss: Loss, scale: float
) -> Refined:
    fit = _fit(observed, observed.points, loss, scale)
    valid = observed.valid & fit.in_front
    noise = _rounding(observed, fit)
    for step in range(steps):
        change, determined = _step(observed, fit, _influence(fit.distance, loss, scale))
        if step == 0:
            valid = valid & determined
        limit = _limit(given.dtype, change.dtype)
        near = ((fit.points + change).detach().abs() < limit).all(dim=-2)
        usable = valid & determined & near
        moved = fit.points + torch.where(usable.unsqueeze(-2), change, 0.0)
        new = _fit(observed, moved, loss, scale)
        # Rounding must not refuse a step at the optimum, of which it carries the gradient.
        highest = (fit.cost.sqrt() + noise).square()
        accepted = usable & new.in_front & (new.cost <= highest)
        merged = (
            torch.where(accepted.unsqueeze(-2) if b.dim() > accepted.dim() else accepted, b, a)
            for a, b in zip(fit, new, strict=True)
        )
        fit = _Fit(*merged)

    # What failed keeps the caller's own digits, and no gradient.
    kept = torch.where(given.isfinite().all(dim=-1, keepdim=True), given, 0.0).detach()
    found = torch.where(valid[..., None], fit.points.mT.to(given.dtype), kept)
    total = observed.squared.sum(dim=-2)
    mean = safe_divide((observed.squared * fit.distance).sum(dim=-2), total, valid)
    positive = valid & (mean > 0)
    # sqrt has an infinite slope at a perfect match; its gradient there is taken as 0.
    residual = torch.where(positive, torch.where(positive, mean, 1.0).sqrt(), 0.0)
    return Refined(found, residual.to(given.dtype), valid)


def _rounding(observed: _Observations, fit: _Fit) -> Tensor:
    """What rounding of the projections may add to the square root of the cost, ``(*B, N)``."""
    with torch.no_grad():
        size = observed.directions.abs() @ fit.points.abs().unsqueeze(-3)
        size = (size + observed.positions.abs())[..., :2, :].amax(dim=-2) * fit.inverse
        size = size + observed.x.abs() + observed.y.abs()
        largest = (observed.squared.sqrt() * size).amax(dim=-2)
        return 16 * torch.finfo(size.dtype).eps * (largest + fit.cost.sqrt())


def _step(observed: _Observations, fit: _Fit, influence: Tensor) -> tuple[Tensor, Tensor]:
    """The Gauss-Newton step ``(*B, 3, N)``, and whether the views determine it ``(*B, N)``."""
    p1, p2, p3 = observed.directions.unbind(dim=-2)
    rows, columns = _UPPER

    def outer(a: Tensor, b: Tensor) -> Tensor:
        return (a[..., rows] * b[..., columns] + b[..., rows] * a[..., columns]) / 2

    # As in triangulation: every entry is linear in (x^2 + y^2, x, y, 1), one matrix product.
    coefficients = torch.stack(
        [outer(p3, p3), -2 * outer(p3, p1), -2 * outer(p3, p2), outer(p1, p1) + outer(p2, p2)],
        dim=-2,
    )  # (*B, V, 4, 6)
    x, y, inverse = fit.x, fit.y, fit.inverse
    once = observed.squared * influence * inverse
    twice = once * inverse
    terms = torch.stack([(x * x + y * y) * twice, x * twice, y * twice, twice], dim=-2)
    normal = coefficients.flatten(-3, -2).mT @ terms.flatten(-3, -2)
    error_x, error_y = x - observed.x, y - observed.y
    terms = torch.stack(
        [-error_x * once, -error_y * once, (error_x * x + error_y * y) * once], dim=-2
    )
    right = observed.directions.flatten(-3, -2).mT @ terms.flatten(-3, -2)
    return _solve3(normal, right)


def _solve3(normal: Tensor, right: Tensor) -> tuple[Tensor, Tensor]:
    """Solve symmetric 3x3 systems by LDL; 0 with zero gradient where not definite.

    Args:
        normal: ``(*B, 6, N)`` upper triangles, row by row.
        right: ``(*B, 3, N)``.

    Returns:
        ``(*B, 3, N)``, and whether the matrix is definite beyond rounding ``(*B, N)``.
    """
    eps = torch.finfo(normal.dtype).eps
    trace = (normal[..., 0, :] + normal[..., 3, :] + normal[..., 5, :]).detach()
    limit = torch.finfo(trace.dtype).max ** 0.5
    ordinary = (trace > 1 / limit) & (trace < limit)
    ordinary = ordinary & (right.detach().abs() < limit).all(dim=-2)
    share = torch.where(ordinary, 1 / torch.where(ordinary, trace, 1.0), 0.0)
    where = ordinary.unsqueeze(-2)
    a00, a01, a02, a11, a12, a22 = torch.where(
        where, normal * share.unsqueeze(-2), normal.new_tensor([1, 0, 0, 1, 0, 1.0])[:, None]
    ).unbind(dim=-2)
    b0, b1, b2 = torch.where(where, right * share.unsqueeze(-2), 0.0).unbind(dim=-2)

    def reciprocal(pivot: Tensor) -> tuple[Tensor, Tensor]:
        definite = pivot > 64 * eps
        return 1 / torch.where(definite, pivot, 1.0), definite

    i0, definite0 = reciprocal(a00)
    l10, l20 = a01 * i0, a02 * i0
    i1, definite1 = reciprocal(a11 - l10 * a01)
    t = a12 - l20 * a01
    l21 = t * i1
    i2, definite2 = reciprocal(a22 - l20 * a02 - l21 * t)
    b1 = b1 - l10 * b0
    z2 = (b2 - l20 * b0 - l21 * b1) * i2
    z1 = b1 * i1 - l21 * z2
    z0 = b0 * i0 - l10 * z1 - l20 * z2
    definite = ordinary & definite0 & definite1 & definite2
    solution = torch.stack([z0, z1, z2], dim=-2)
    return torch.where(definite.unsqueeze(-2), solution, 0.0), definite
