"""Gauss-Newton on the reprojection error of given points, with robust losses.

A step is triangulation's normal matrix at the projected pixels and a 3x3 solve. From points
triangulated in the rig frame one step is enough for all but gross outliers.
"""

from collections.abc import Callable
from functools import partial
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import safe_sqrt
from deltas_geom.checks import check_counts, check_positive
from deltas_geom.numerics.arithmetic import outside_gradients, without_autocast, without_gradients
from deltas_geom.numerics.chunks import cut_points
from deltas_geom.numerics.evaluation import recomputed
from deltas_geom.numerics.sums import over_views
from deltas_geom.numerics.symmetric3 import solve3_scaled
from deltas_geom.numerics.vectors import Symmetric3, Vector3, dot, either
from deltas_geom.records import Record
from deltas_geom.triangulation.dlt import normal_coefficients, normal_matrix
from deltas_geom.triangulation.observed import (
    Observations,
    check_observed,
    clean_points,
    farthest,
    finite_cameras,
    homogeneous_in_views,
    observe,
)
from deltas_geom.triangulation.robust_loss import Loss, robust_loss, second_derivative

_Loss = Callable[[Tensor], tuple[Tensor, Tensor, Tensor]]
_End = tuple[Vector3, Tensor, Tensor]  # points (*B, N) m, their _Fit.error, are they valid?
_Descent = Callable[["_Problem", int], _End]
_SHORTER = 0.25  # of a step that was refused
_FARTHEST = 1e10  # px: a projection farther out than this is as good as behind the camera


class Refined(Record):
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


@without_autocast
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
    gradient: Literal["unrolled", "implicit"] = "unrolled",
) -> Refined:
    r"""Move points so that their projections come closer to the pixels.

    Gauss-Newton on :math:`\sum_v w_v^2 \rho(\|e_v\|^2)`, e the distance in pixels. A robust loss
    re-weights the views at each step (iteratively re-weighted least squares). A step is taken only
    where this cost grows by no more than rounding and the point stays in front of all used views;
    elsewhere the point is kept, and the next step is a quarter of the refused one.

    Gradients: "unrolled" are those of the steps taken, however few; they also reach the
    ``points`` given, and cost as much as the steps. "implicit" are those of the optimum, by the
    implicit function theorem: at the cost of one step, without the lag with which unrolled ones
    follow a robust loss, but right only where the points have converged, of first order alone,
    and 0 for the ``points`` given. Take "unrolled" for a step or two, "implicit" for many.

    Args:
        proj: ``(*B, V, 3, 4)`` K [R | t].
        pixels: ``(*B, V, N, 2)`` matches; those of unused views may hold anything.
        points: ``(*B, N, 3)`` in the world, metres: where to start. The (0, 0, 0) of a failed
            triangulation is a place like any other: only what was valid before still is.
        weights: ``(*B, V, N)`` not negative (a sign has no effect). 0 = unused. Ratios count.
        mask: ``(*B, V, N)`` bool, True = used.
        steps: of Gauss-Newton. 0 judges the points without moving them.
        loss: "squared", "huber" (linear beyond ``scale``) or "cauchy" (logarithmic).
        scale: px, the distance of a view at which a robust loss begins to doubt it.
        gradient: values do not depend on it. "implicit" is 0 where there is no strict minimum.

    Returns:
        Points, residual (large also of pixels (N, V, 2), N = V), could they be refined? No NaN.

    Raises:
        ShapeError, TypeError: a trailing shape differs, there is no view, the mask is not bool.
        ValueError: unknown loss or gradient, negative number of steps, scale not positive.

    Source: Hartley and Zisserman, 2nd ed., appendix 6, and section 5.2.6 (implicit functions);
    Triggs et al., Bundle Adjustment: A Modern Synthesis (2000), section 4.3.

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
    batch = check_observed(proj=proj, pixels=pixels, weights=weights, mask=mask, points=points)
    if loss not in ("squared", "huber", "cauchy"):
        raise ValueError(f"loss must be 'squared', 'huber' or 'cauchy', got {loss!r}")
    if gradient not in ("unrolled", "implicit"):
        raise ValueError(f"gradient must be 'unrolled' or 'implicit', got {gradient!r}")
    check_counts(0, steps=steps)
    check_positive(scale=scale)

    def refined(descend: _Descent, *inputs: Tensor) -> tuple[Tensor, ...]:
        problem = _pose(partial(robust_loss, loss, scale), batch, *inputs)
        return _outward(problem, *descend(problem, steps), dtype=points.dtype)

    unrolled, implicit = partial(refined, _descend), partial(refined, _descend_implicitly)
    derivable = unrolled if gradient == "unrolled" else implicit
    cut = cut_points(pixels, -2, -2, -1, -1, outputs=(-2, -1, -1))
    known = (proj, pixels, points, weights, mask)
    return Refined(*recomputed(derivable, *known, values=unrolled, cut=cut))


class _Problem(NamedTuple):
    """What is to be minimised, and from where.

    Attributes:
        proj: ``(*B, V, 3, 4)`` of the cameras.
        observed: pixels and weights.
        robust: the loss, see :func:`robust_loss`.
        start: three ``(*B, N)`` m; 0 where not finite.
        sound: ``(*B, N)`` bool: finite, and two or more views are used.
        limit: m, where points stop to be representable.
    """

    proj: Tensor
    observed: Observations
    robust: _Loss
    start: Vector3
    sound: Tensor
    limit: float


def _pose(
    robust: _Loss,
    batch: torch.Size,
    proj: Tensor,
    pixels: Tensor,
    points: Tensor,
    weights: Tensor | None,
    mask: Tensor | None,
) -> _Problem:
    cameras, _ = finite_cameras(proj)  # no point is in front of a broken one
    observed = observe(pixels, weights, mask, batch)
    start, finite = clean_points(points)
    sound = observed.weights.sound & finite & (observed.weights.used.sum(dim=-2) >= 2)
    limit = min(farthest(cameras.dtype), torch.finfo(points.dtype).max)
    return _Problem(cameras, observed, robust, start, sound, limit)


class _Fit(NamedTuple):
    """Points as views see them.

    Attributes:
        place: x and y ``(*B, V, N)`` px of the projections.
        offset: x and y ``(*B, V, N)`` px, from the pixels to there.
        inverse: ``(*B, V, N)`` 1 / depth.
        influence: ``(*B, V, N)`` rho', or () if all alike.
        bend: ``(*B, V, N)`` 2 rho'', or ().
        error: ``(*B, N)`` px^2, weighted sum of the squared distances.
        cost: ``(*B, N)`` px^2, of the loss, without gradient; infinite if not in front of all.
    """

    place: tuple[Tensor, Tensor]
    offset: tuple[Tensor, Tensor]
    inverse: Tensor
    influence: Tensor
    bend: Tensor
    error: Tensor
    cost: Tensor


def _fit(problem: _Problem, points: Vector3) -> _Fit:
    observed = problem.observed
    a, b, c = homogeneous_in_views(problem.proj, (*points, torch.ones_like(points[0])))
    with outside_gradients():
        # Far enough from overflow for squares of all that is divided by the depth.
        smallest = torch.finfo(c.dtype).tiny ** (1 / 6)
        least = (torch.maximum(a.abs(), b.abs()) * (1 / _FARTHEST)).clamp(min=smallest)
    depth = torch.maximum(c, least)
    inverse, (px, py) = depth.reciprocal(), (observed.x, observed.y)
    x, y = a * inverse, b * inverse
    dx, dy = x - px, y - py
    distance = torch.addcmul(dx * dx, dy, dy)
    error = (observed.weights.squared * distance).sum(dim=-2)
    rho, influence, bend = problem.robust(distance)
    with outside_gradients():
        behind = ((depth - c) * observed.weights.used).sum(dim=-2) > 0
        cost = error if rho is distance else (observed.weights.squared * rho).sum(dim=-2)
    cost = torch.where(behind, torch.inf, cost.detach())
    return _Fit((x, y), (dx, dy), inverse, influence, bend, error, cost)


def _descend(problem: _Problem, steps: int) -> _End:
    points, fit = problem.start, _fit(problem, problem.start)
    error, cost, valid = fit.error, fit.cost, problem.sound & (fit.cost < torch.inf)
    noise, moving, change, refused = _rounding(problem, fit), valid, points, ~valid
    for step in range(steps):
        by, determined = solve3_scaled(*_normal_equations(problem, fit))
        if step == 0:
            moving = valid = valid & determined
        else:  # Of what was refused the fit is of another place: the same step, but shorter.
            by = either(refused, tuple(_SHORTER * before for before in change), by)
        change, moving = by, moving & (determined | refused)
        moved = tuple(x + by for x, by in zip(points, change, strict=True))
        x, y, z = (component.detach().abs() for component in moved)
        within = moving & (x + y + z < problem.limit)
        moved = either(within, moved, points)
        fit = _fit(problem, moved)
        # Rounding must not refuse a step at the optimum, of which it carries the gradient.
        rounded = cost * (1 + 32 * torch.finfo(cost.dtype).eps) + noise
        taken = within & (fit.cost < torch.add(rounded, safe_sqrt(cost * noise), alpha=2))
        points, refused = either(taken, moved, points), ~taken
        error, cost = either(taken, (fit.error, fit.cost), (error, cost))
    return points, error, valid


@without_gradients
def _rounding(problem: _Problem, fit: _Fit) -> Tensor:
    """What rounding of the projections may cost a perfect match, ``(*B, N)`` px^2."""
    by_depth = problem.observed.weights.squared * fit.inverse * fit.inverse
    size = problem.proj[..., :2, :].square().sum(dim=-2)  # of the rows
    turned, shifted = size[..., :3].sum(dim=-1, keepdim=True), size[..., 3:]
    reach = dot(problem.start, problem.start).unsqueeze(-2)
    squared = (torch.addcmul(shifted, turned, reach) * by_depth).sum(dim=-2)
    info = torch.finfo(squared.dtype)
    return squared.mul((16 * info.eps) ** 2).add(info.tiny**0.5)


def _normal_equations(problem: _Problem, fit: _Fit) -> tuple[Symmetric3, Vector3]:
    """J^T W^2 J and -J^T W^2 e of the re-weighted views, e the distances."""
    directions, (x, y), (dx, dy) = problem.proj[..., :3], fit.place, fit.offset
    once = problem.observed.weights.squared * fit.influence * fit.inverse
    # The derivative of a pixel by the point is its equations, divided by the depth.
    normal = normal_matrix(normal_coefficients(directions), x, y, once * fit.inverse)
    across, down = dx * once, dy * once
    terms = torch.stack([across, down, torch.addcmul(across * x, down, y)], dim=-2)
    rows = torch.cat([-directions[..., :2, :], directions[..., 2:, :]], dim=-2).flatten(-3, -2)
    return normal, over_views(rows.mT, terms.flatten(-3, -2))


def _descend_implicitly(problem: _Problem, steps: int) -> _End:
    """:func:`_descend`, with the derivatives of the point at which the cost's gradient g is 0.

    They are -H^-1 dg with the cost's whole second derivative H. Gauss-Newton's normal matrix,
    which leaves out how residuals and losses bend, would be wrong by their share.
    """
    with outside_gradients():
        end, _, valid = _descend(problem, steps)
    end = tuple(component.detach() for component in end)
    fit = _fit(problem, end)
    normal, right = _normal_equations(problem, fit)
    seen, squared = (fit.place, fit.offset, fit.inverse), problem.observed.weights.squared
    with outside_gradients():
        counted = squared * fit.influence, squared * fit.bend
        hessian = second_derivative(normal, problem.proj, *seen, *counted)
    change, strict = solve3_scaled(tuple(entry.detach() for entry in hessian), right)
    points = tuple(
        # A gradient of 0 to the start, not a missing one; of the step no value.
        p + 0 * s + torch.where(strict & valid, d - d.detach(), 0.0)
        for p, s, d in zip(end, problem.start, change, strict=True)
    )
    return points, _fit(problem, points).error, valid


def _outward(
    problem: _Problem, points: Vector3, error: Tensor, valid: Tensor, *, dtype: torch.dtype
) -> tuple[Tensor, ...]:
    # What failed keeps the caller's own digits, and no gradient.
    kept = either(valid, points, [component.detach() for component in problem.start])
    found, total = torch.stack(kept, dim=-1), problem.observed.weights.squared.sum(dim=-2)
    # The largest squared weight is 1: less is no view.
    residual = safe_sqrt(torch.where(valid, error, 0.0) / total.clamp(min=1))
    residual = residual.clamp(max=torch.finfo(dtype).max)
    return found.to(dtype), residual.to(dtype), valid
