"""The frame in which a point is solved, and what becomes of it there.

Origin: the mean of the centres of the cameras that see the point, weighted as they are. Unit:
their spread. In this rig frame the algebraic error is nearly the angular one, the answer does not
depend on the world's origin or unit, and a view that is not used leaves no trace.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.numerics.chunks import surely_all
from deltas_geom.numerics.ldl import Symmetric4, Vector4, unit
from deltas_geom.numerics.null_vector import null_vector, rayleigh_step
from deltas_geom.status import Status
from deltas_geom.triangulation.observed import Vector3, Weights, over_views

# Of the inputs' rounding: an error of the solver that is lost in it.
_NEGLIGIBLE = 0.01


class RigFrame(NamedTuple):
    """Where each of N points is solved: X = unit x + origin.

    Attributes:
        origin: three ``(*B, N)``, relative to the origin of the sums.
        unit: ``(*B, N)`` positive.
        middle: three ``(*B, N)``, of the used cameras, without gradient.
        reach: ``(*B, N)`` squared spread of the used cameras, all alike, around ``middle``.
        posed: ``(*B, N)`` bool: two or more cameras, apart by more than rounding.
        enough: ``(*B, N)`` bool: two or more cameras.
        finite: ``(*B, N)`` bool: everything that is used is.
    """

    origin: Vector3
    unit: Tensor
    middle: Vector3
    reach: Tensor
    posed: Tensor
    enough: Tensor
    finite: Tensor


def rig_frames(
    centers: Tensor, weights: Weights, sick: Tensor, *, eps: float
) -> tuple[Tensor, RigFrame]:
    """The origin of the sums ``(*B, 1, 3)`` in the world, and the frame of each point.

    Args:
        centers: ``(*B, V, 3)`` of the cameras, in the world.
        weights: of N points.
        sick: ``(*B, V)`` 1 for cameras that are not finite, else 0.
        eps: rounding of the inputs, relative.
    """
    with torch.no_grad():
        # Cameras that no point uses may stand anywhere.
        seen = _any(weights.used).unsqueeze(-1)
        count = seen.sum(dim=-2, keepdim=True).clamp(min=1)
        around = torch.where(seen, centers, 0.0).sum(dim=-2, keepdim=True) / count
    weighted, counted = camera_moments(centers, around, sick)
    sums = over_views(weighted, weights.squared), over_views(counted, weights.used)
    frame = rig_frame(*sums, eps=eps)
    return around, frame._replace(finite=frame.finite & weights.sound)


def _any(used: Tensor) -> Tensor:
    return used.sum(dim=-1) > 0


def camera_moments(centers: Tensor, around: Tensor, sick: Tensor) -> tuple[Tensor, Tensor]:
    """What is summed over each point's cameras, ``(*B, 5, V)`` weighted and ``(*B, 7, V)`` not.

    Args:
        centers: ``(*B, V, 3)`` of the cameras.
        around: ``(*B, 1, 3)`` the origin of the sums, near the cameras.
        sick: ``(*B, V)`` 1 for cameras that are not finite, else 0.
    """
    offset = centers - around
    square = offset.square().sum(dim=-1, keepdim=True)
    weighted = torch.cat([torch.ones_like(square), square, offset], dim=-1)
    from_world = centers.square().sum(dim=-1, keepdim=True).expand_as(square)
    counted = torch.cat([weighted, from_world, sick.unsqueeze(-1).expand_as(square)], dim=-1)
    return weighted.mT, counted.detach().mT


def rig_frame(weighted: tuple[Tensor, ...], counted: tuple[Tensor, ...], *, eps: float) -> RigFrame:
    """The frame of each point from sums over its cameras.

    Args:
        weighted: five ``(*B, N)``, the first of :func:`camera_moments`, by squared weights.
        counted: seven ``(*B, N)``, the second, each used view once.
        eps: rounding of the inputs, relative.
    """
    total, square, x, y, z = weighted
    # The largest squared weight is 1: less is no view, and its sums are 0.
    inverse = total.clamp(min=1).reciprocal()
    origin = (x * inverse, y * inverse, z * inverse)
    spread = square * inverse - _squared_length(origin)
    with torch.no_grad():
        count, size, mx, my, mz, from_world, sick = counted
        share = count.clamp(min=1).reciprocal()
        size, middle = size * share, (mx * share, my * share, mz * share)
        reach = size - _squared_length(middle)
        # Centres closer together than the rounding of where they are do not differ.
        least = (64 * eps) ** 2 * share * from_world
        least = torch.maximum(least, 16 * torch.finfo(size.dtype).eps * size)
        enough = count >= 2
        posed = enough & (reach > least)
        apart = spread > 1e-3 * torch.finfo(size.dtype).eps * size
    length = torch.where(apart, spread, spread.new_ones(())).sqrt()
    return RigFrame(origin, length, middle, reach, posed, enough, sick == 0)


def _squared_length(vector: Vector3) -> Tensor:
    x, y, z = vector
    return torch.addcmul(torch.addcmul(x * x, y, y), z, z)


def in_frame(normal: Symmetric4, origin: Vector3, length: Tensor) -> Symmetric4:
    """T^T M T for homogeneous points X = x + origin w / length.

    The unit is on w alone, which is the same up to scale and cheaper.
    """
    m00, m01, m02, m03, m11, m12, m13, m22, m23, m33 = normal
    o0, o1, o2 = origin

    def moved(last: Tensor, a: Tensor, b: Tensor, c: Tensor) -> Tensor:
        return torch.addcmul(torch.addcmul(torch.addcmul(last, a, o0), b, o1), c, o2)

    n03, n13, n23 = moved(m03, m00, m01, m02), moved(m13, m01, m11, m12), moved(m23, m02, m12, m22)
    n33 = moved(moved(m33, m03, m13, m23), n03, n13, n23)
    inverse = length.reciprocal()
    return (
        m00, m01, m02, n03 * inverse,
        m11, m12, n13 * inverse,
        m22, n23 * inverse,
        n33 * (inverse * inverse),
    )  # fmt: skip


class FoundPoints(NamedTuple):
    """Points before they are judged; without gradient.

    Attributes:
        points: three ``(*B, N)``, relative to the origin of the sums; anything if there is none.
        vector: homogeneous, in the frame, of any length and sign.
        posed: ``(*B, N)`` bool: there is a place or a direction.
        near: ``(*B, N)`` bool: there is a place.
    """

    points: Vector3
    vector: Vector4
    posed: Tensor
    near: Tensor


@torch.no_grad()
def find_points(
    normal: Symmetric4,
    frame: RigFrame,
    *,
    eps: float,
    product: Callable[[Vector4], Vector4] | None = None,
    polish: int = 0,
    columns: Vector4 | None = None,
) -> FoundPoints:
    """The points that minimise the algebraic error.

    Args:
        normal: ten ``(*B, N)``, of homogeneous points of :func:`in_frame`.
        frame: of the points.
        eps: rounding of the inputs, relative.
        product: see :func:`deltas_geom.numerics.null_vector.null_vector`.
        polish: see there.
        columns: see there.
    """
    (x0, x1, x2, x3), simple = null_vector(
        normal, accuracy=_NEGLIGIBLE * eps, product=product, polish=polish, columns=columns
    )
    points = _at_distance((x0, x1, x2), frame.unit / x3, frame.origin)
    (x, y, z), (mx, my, mz) = points, frame.middle
    distance = _squared_length((x - mx, y - my, z - mz))
    near = (16 * eps) ** 2 * distance <= frame.reach
    return FoundPoints(points, (x0, x1, x2, x3), frame.posed & simple, near)


def _at_distance(direction: Vector3, distance: Tensor, origin: Vector3) -> Vector3:
    (x, y, z), (ox, oy, oz) = direction, origin
    return (
        torch.addcmul(ox, x, distance),
        torch.addcmul(oy, y, distance),
        torch.addcmul(oz, z, distance),
    )


def derivable_points(
    normal: Symmetric4, frame: RigFrame, vector: Vector4, valid: Tensor
) -> Vector3:
    """Points relative to the origin of the sums, differentiable; finite where not valid.

    Args:
        normal: as for :func:`find_points`, differentiable.
        frame: of the points.
        vector: found for ``normal``.
        valid: ``(*B, N)`` bool.
    """
    matrix, _ = of_trace_one(normal, valid)
    x0, x1, x2, x3 = derivable_vector(matrix, vector, valid)
    return _at_distance((x0, x1, x2), frame.unit / x3, frame.origin)


def of_trace_one(normal: Symmetric4, valid: Tensor) -> tuple[Symmetric4, Tensor]:
    """The matrices divided by their traces, easy ones where not valid; and what they were
    multiplied by, without gradient.
    """
    # Double where: what has failed must pass no gradient and no NaN.
    easy = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0)
    trace = torch.where(valid, normal[0] + normal[4] + normal[7] + normal[9], 1.0).detach()
    # Of trace 1, so that powers of its entries in the gradient neither overflow nor vanish.
    share = trace.reciprocal()
    m00, m01, m02, m03, m11, m12, m13, m22, m23, m33 = (
        torch.where(valid, entry, constant) * share
        for entry, constant in zip(normal, easy, strict=True)
    )
    return (m00, m01, m02, m03, m11, m12, m13, m22, m23, m33), share


def derivable_vector(matrix: Symmetric4, vector: Vector4, valid: Tensor) -> Vector4:
    """The null vector, of about unit length, as a function of the matrix of trace 1.

    Args:
        matrix: of :func:`of_trace_one`.
        vector: its null vector, of any length; anything where not valid.
        valid: ``(*B, N)`` bool.
    """
    x0, x1, x2, x3 = (
        torch.where(valid, component.detach(), constant)
        for component, constant in zip(vector, (0.0, 0.0, 0.0, 1.0), strict=True)
    )
    start = unit((x0, x1, x2, x3))
    x0, x1, x2, x3 = rayleigh_step(matrix, start)
    # Below the step's rounding there is no derivative, and not even a sign to divide by.
    lost = start[3].abs() <= 4 * torch.finfo(x3.dtype).eps
    return x0, x1, x2, torch.where(lost, start[3], x3)


def in_world(points: Vector3, around: Tensor) -> Vector3:
    """Points in the world, from points relative to the origin of the sums ``(*B, 1, 3)``."""
    (x, y, z), (ox, oy, oz) = points, around.unbind(dim=-1)
    return x + ox, y + oy, z + oz


def kept(points: Vector3, around: Tensor, valid: Tensor) -> Vector3:
    """The valid points in the world, the others 0.

    Args:
        points: three ``(*B, N)`` relative to ``around``.
        around: ``(*B, 1, 3)`` the origin of the sums.
        valid: ``(*B, N)`` bool.
    """
    return kept_in_world(in_world(points, around), valid)


def kept_in_world(points: Vector3, valid: Tensor) -> Vector3:
    """The valid ones of points three ``(*B, N)``, the others 0."""
    if surely_all(valid):
        return points
    zero = points[0].new_zeros(())
    x, y, z = (torch.where(valid, component, zero) for component in points)
    return x, y, z


def judge_points(
    found: FoundPoints, frame: RigFrame, *, in_front: Tensor, representable: Tensor
) -> Tensor:
    """Status ``(*B, N)`` int8 of points.

    Args:
        found: the points.
        frame: of the points.
        in_front: of all used views.
        representable: in the caller's type.
    """
    status = torch.zeros_like(in_front, dtype=torch.int8)
    reasons = (
        (in_front, Status.BEHIND_CAMERA),
        (found.near & representable, Status.AT_INFINITY),
        (found.posed, Status.NO_PARALLAX),
        (frame.enough, Status.TOO_FEW_VIEWS),
        (frame.finite, Status.NOT_FINITE_INPUT),
    )
    if all(surely_all(passed) for passed, _ in reasons):
        return status
    for passed, reason in reasons:
        status = torch.where(passed, status, status.new_full((), reason.value))
    return status
