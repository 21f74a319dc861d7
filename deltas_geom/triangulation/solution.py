"""From normal matrices in their rig frames to points, and the derivative of these.

How the matrices were made, from pixels, rays or lists of observations, does not matter here.
"""

from collections.abc import Callable
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from deltas_geom.numerics.arithmetic import surely_all
from deltas_geom.numerics.ldl import Symmetric4, Vector4, dot, less, multiply, unit
from deltas_geom.numerics.null_vector import null_vector, rayleigh_step
from deltas_geom.triangulation.judge import judge
from deltas_geom.triangulation.observed import Vector3
from deltas_geom.triangulation.rig_frame import RigFrame, squared_length

# Of the inputs' rounding: an error of the solver that is lost in it.
_NEGLIGIBLE = 0.01


class Linear(Protocol):
    """Equations of N homogeneous points, linear in them, each in its own frame."""

    @property
    def normal(self) -> Symmetric4:
        """Ten ``(*B, N)``: the normal matrices."""

    @property
    def frame(self) -> RigFrame:
        """Of the points."""

    @property
    def datum(self) -> Tensor:
        """``(*B, 1, 3)`` the origin of the sums, in the world."""

    @property
    def dtype(self) -> torch.dtype:
        """Of the inputs."""

    def product(self, x: Vector4) -> Vector4:
        """The normal matrices times vectors, by the rows: not squared."""

    def in_front(self, points: Vector3) -> Tensor:
        """Are points, relative to the datum, in front of all who see them? ``(*B, N)``."""


class Solution(NamedTuple):
    """Points, and what a derivative begins with.

    Attributes:
        points: three ``(*B, N)``, relative to the datum; anything if there is none.
        vector: homogeneous, in the frame.
    """

    points: Vector3
    vector: Vector4


def solve_linear(equations: Linear) -> tuple[Solution, Tensor]:
    """The points that minimise the algebraic error, without gradient, and their status."""
    eps, frame = torch.finfo(equations.dtype).eps, equations.frame
    # What the normal matrix loses of the rows' digits matters to those who have them.
    polish = 2 if equations.dtype == torch.float64 else 0

    def product(x: Vector4) -> Vector4:  # a compiler takes no bound method
        return equations.product(x)

    found = find_points(equations.normal, frame, eps=eps, product=product, polish=polish)
    x, y, z = in_world(found.points, equations.datum)
    held = x.abs() + y.abs() + z.abs() <= torch.finfo(equations.dtype).max
    status = judge(
        finite=frame.finite,
        enough=frame.enough,
        posed=found.posed,
        near=found.near & held,
        in_front=equations.in_front(found.points),
    )
    return Solution(found.points, found.vector), status


def follow_linear(equations: Linear, found: Solution, valid: Tensor) -> Solution:
    """The same, differentiably; finite where not valid."""
    points = derivable_points(equations.normal, equations.frame, found.vector, valid)
    return found._replace(points=points)


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
) -> FoundPoints:
    """The points that minimise the algebraic error.

    Args:
        normal: ten ``(*B, N)``, of homogeneous points of :func:`in_frame`.
        frame: of the points.
        eps: rounding of the inputs, relative.
        product: see :func:`deltas_geom.numerics.null_vector.null_vector`.
        polish: see there.
    """
    (x0, x1, x2, x3), simple = null_vector(
        normal, accuracy=_NEGLIGIBLE * eps, product=product, polish=polish
    )
    points = _at_distance((x0, x1, x2), frame.unit / x3, frame.origin)
    (x, y, z), (mx, my, mz) = points, frame.middle
    distance = squared_length((x - mx, y - my, z - mz))
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
        normal: as for :func:`find_points`, differentiable, but for the frame, which is held.
        frame: of the points.
        vector: found for ``normal``.
        valid: ``(*B, N)`` bool.
    """
    matrix, _ = of_trace_one(normal, valid)
    held = frame.held()
    x0, x1, x2, x3 = derivable_vector(matrix, vector, valid, frame)
    return _at_distance((x0, x1, x2), held.unit / x3, held.origin)


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


def derivable_vector(
    matrix: Symmetric4, vector: Vector4, valid: Tensor, frame: RigFrame
) -> Vector4:
    """The null vector, of about unit length, as a function of the matrix and of the frame.

    Args:
        matrix: of :func:`of_trace_one`.
        vector: its null vector, of any length; anything where not valid.
        valid: ``(*B, N)`` bool.
        frame: of the points, differentiable.
    """
    x0, x1, x2, x3 = (
        torch.where(valid, component.detach(), constant)
        for component, constant in zip(vector, (0.0, 0.0, 0.0, 1.0), strict=True)
    )
    start = unit((x0, x1, x2, x3))
    x0, x1, x2, x3 = rayleigh_step(_measured(matrix, start, valid, frame), start)
    # Below the step's rounding there is no derivative, and not even a sign to divide by.
    lost = start[3].abs() <= 4 * torch.finfo(x3.dtype).eps
    return x0, x1, x2, torch.where(lost, start[3], x3)


def _measured(matrix: Symmetric4, x: Vector4, valid: Tensor, frame: RigFrame) -> Symmetric4:
    """M - mu (N - 1), which is M, with what the frame does to its null vector x.

    In another frame S x stands for x, and x^T M x is the least at S^T S = N: M x = mu N x. To
    derive S^T M S instead would leave the rounding of M x, which a small unit multiplies.
    """
    held, zero = frame.held(), torch.zeros_like(matrix[0])
    grown = held.unit / frame.unit
    b0, b1, b2 = (
        torch.where(valid, (before - now) / frame.unit, 0.0)
        for before, now in zip(held.origin, frame.origin, strict=True)
    )
    same = torch.where(valid, grown * grown - 1, 0.0)
    norm = (
        same, zero, zero, grown * b0,
        same, zero, grown * b1,
        same, grown * b2,
        b0 * b0 + b1 * b1 + b2 * b2,
    )  # fmt: skip
    mu = dot(x, multiply(matrix, x)) / (1 + dot(x, multiply(norm, x)))
    m00, m01, m02, m03, m11, m12, m13, m22, m23, m33 = (
        less(entry, mu, part) for entry, part in zip(matrix, norm, strict=True)
    )
    return m00, m01, m02, m03, m11, m12, m13, m22, m23, m33


def in_world(points: Vector3, datum: Tensor) -> Vector3:
    """Points in the world, from points relative to the origin of the sums ``(*B, 1, 3)``."""
    (x, y, z), (ox, oy, oz) = points, datum.unbind(dim=-1)
    return x + ox, y + oy, z + oz


def kept(points: Vector3, valid: Tensor) -> Vector3:
    """The valid ones of points three ``(*B, N)``, the others 0."""
    if surely_all(valid):
        return points
    zero = points[0].new_zeros(())
    x, y, z = (torch.where(valid, component, zero) for component in points)
    return x, y, z
