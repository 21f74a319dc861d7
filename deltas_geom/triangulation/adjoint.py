"""The gradient of points, from their equations: nothing of how they were found is derived.

A change dM of a normal matrix changes its null vector x by -(M - mu)^+ dM x, and with it a sum
whose gradient by x is g by -y^T dM x, y = (M - mu)^+ g. M being a sum of squared rows, that is a
product of the errors of x and of y, whose derivatives by pixels, weights and cameras are plain.

Source: Griewank and Walther, Evaluating Derivatives, 2nd ed., chapter 15 (implicit functions).
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from deltas_geom.numerics.ldl import multiply
from deltas_geom.numerics.null_vector import solve_in_complement
from deltas_geom.numerics.sums import over_points, product
from deltas_geom.numerics.vectors import Numbers, Vector3, Vector4, as_one, dot, either, scaled
from deltas_geom.triangulation.equations import Equations, out_of_frame
from deltas_geom.triangulation.observed import Observations, homogeneous_in_views
from deltas_geom.triangulation.solution import of_length_one, of_trace_one
from deltas_geom.triangulation.weights import Weights


def gradients_of(
    equations: Equations,
    vector: Vector4,
    valid: Tensor,
    gradient: Vector3,
    *,
    weights: Tensor | None,
    of_cameras: bool,
    dtype: torch.dtype,
) -> tuple[Tensor | None, Tensor, Tensor | None]:
    """Of the sum of gradient * points, to first order, by what the equations were made of.

    The vectors are null vectors in the frame, anything where not valid; weights None if they need
    no gradient.

    Returns:
        ``(*B, V, 3, 4)`` or None, ``(*B, V, N, 2)`` in the dtype of pixels, ``(*B, V, N)`` or None;
        broadcast as the inputs were.
    """
    place, push, framed = _pulled(equations, vector, valid, gradient)
    rig, (x, y, known) = equations.rig, equations.observed
    (a, b, c), (d, e, f) = (homogeneous_in_views(rig.near, some) for some in (place, push))
    across, down, along, below = x * c - a, y * c - b, x * f - d, y * f - e
    by_x = torch.addcmul(f * across, c, along) * -known.squared
    by_y = torch.addcmul(f * down, c, below) * -known.squared
    proj = by_weight = None
    if weights is not None:
        by_square = product(rig.moments[0].mT, torch.stack(framed, dim=-2))
        by_square = by_square - torch.addcmul(across * along, down, below)
        by_weight = (by_square * _slope(known, weights)).to(weights.dtype)
    if of_cameras:
        stacked = [torch.stack(some, dim=-2) for some in (place, push, framed[1:])]
        sums = _over_points(equations.observed, (across, down), (along, below), *stacked)
        cameras = rig.cameras
        columns = through_centers(
            *sums, inverse=cameras.inverse, places=cameras.centers, datum=rig.datum
        )
        proj = torch.cat(columns, dim=-1) * (1 - cameras.broken)[..., None, None]
    return proj, as_one((by_x, by_y), dtype), by_weight


def _slope(known: Weights, weights: Tensor) -> Tensor:
    """Derivative of the squared weights by the weights ``(*B, V, N)``, 0 where unused."""
    share = torch.where(known.squared > 0, weights, 0.0) / known.largest
    return 2 * share / known.largest


def _over_points(
    part: Observations,
    errors: tuple[Tensor, Tensor],
    pushed: tuple[Tensor, Tensor],
    place: Tensor,
    push: Tensor,
    framed: Tensor,
) -> tuple[Tensor, Tensor]:
    """Gradients ``(*B, V, 3, 4)`` by the cameras near the datum, ``(*B, V, 4)`` of the frames."""
    x, y, known = part
    (u, v), (p, q) = ([error * known.squared for error in some] for some in (errors, pushed))
    rows = ((u, p), (v, q), (-torch.addcmul(x * u, y, v), -torch.addcmul(x * p, y, q)))
    near = [over_points(one, push) + over_points(other, place) for one, other in rows]
    return torch.stack(near, dim=-2), over_points(known.squared.expand_as(u), framed)


def _pulled(
    equations: Equations, vector: Vector4, valid: Tensor, gradient: Vector3
) -> tuple[Vector4, Vector4, tuple[Tensor, ...]]:
    """What of the points' gradient reaches the equations.

    The points and y, homogeneous, from the datum, four ``(*B, N)`` each; and five, of 1, the
    squared distance of a camera from the datum and its three coordinates: the gradient by a view's
    squared weight, through the frame.
    """
    frame = equations.frame
    matrix, share = of_trace_one(equations.normal, valid)
    g, x = either(valid, gradient, (0.0,) * 3), of_length_one(vector, valid)
    mu = dot(x, multiply(matrix, x))
    scale = frame.unit * share / x[3]
    along = dot(g, x[:3]) / x[3]
    y = solve_in_complement(matrix, x, mu, (*scaled(g, scale), -along * scale))
    by_unit = 2 * mu / (share * frame.unit) * (0.0 if equations.fixed else 1.0)
    framed = through_frame(x, y, frame.origin, frame.unit, by_unit / (2 * frame.total))
    return out_of_frame(frame, x), out_of_frame(frame, y), framed


def through_frame(
    x: Sequence[Numbers],
    y: Sequence[Numbers],
    origin: Sequence[Numbers],
    unit: Numbers,
    share: Numbers,
) -> tuple[Numbers, ...]:
    """What of the gradient by a view's squared weight the frame's origin and unit pass on.

    They matter where the errors do not vanish: M x = mu x and M y = mu y + of_x leave little of
    what T^T M T says.

    Args:
        x, y: four ``(*B, N)`` in the frame, tensors or arrays as all others.
        origin, unit: of the frame.
        share: the eigenvalue by the unit and by the sum of squared weights; 0 if it is fixed.

    Returns:
        Five: of 1, of the squared distance of a camera from the datum and of its coordinates.
    """
    o0, o1, o2 = origin
    of_x, of_y = share * y[3], share * x[3]
    square = of_x * x[3] / unit
    twice = 2 * square
    a, b, c = (-(of_x * x[k] + of_y * y[k] + twice * origin[k]) for k in range(3))
    constant = -square * (o0 * o0 + o1 * o1 + o2 * o2 + unit * unit) - (a * o0 + b * o1 + c * o2)
    return constant, square, a, b, c


def through_centers(
    near: Numbers, centers: Numbers, *, inverse: Numbers, places: Numbers, datum: Numbers
) -> tuple[Numbers, Numbers]:
    """Gradients by the columns of cameras ``(*B, V, 3, 3)`` and ``(*B, V, 3, 1)``.

    Args:
        near: ``(*B, V, 3, 4)`` by those of points counted from the datum; tensor or array.
        centers: ``(*B, V, 4)`` by squared distances from the datum and coordinates there.
        inverse, places, datum: of the cameras, see :class:`Cameras` and :class:`Rig`.
    """
    last = near[..., 3:]
    center = centers[..., 1:] + 2 * (places - datum) * centers[..., :1]
    # By the last column, and through it by the others.
    position = -(inverse * center[..., None]).sum(-2)[..., None]
    rows = near[..., :3] + last * datum[..., None, :] + position * places[..., None, :]
    return rows, last + position
