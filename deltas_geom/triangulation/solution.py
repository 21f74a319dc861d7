"""From normal matrices in their rig frames to points, and the derivative of these.

How the matrices were made, from pixels, rays or lists of observations, does not matter here.
"""

from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from deltas_geom.numerics.arithmetic import surely_all, without_gradients
from deltas_geom.numerics.ldl import multiply, trace_of
from deltas_geom.numerics.null_vector import null_vector, rayleigh_step
from deltas_geom.numerics.vectors import (
    Symmetric4,
    Vector3,
    Vector4,
    dot,
    either,
    minus,
    plus,
    scaled,
    unit,
)
from deltas_geom.triangulation.judge import judge
from deltas_geom.triangulation.rig_frame import RigFrame

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


@without_gradients
def solve_linear(equations: Linear) -> tuple[Solution, Tensor]:
    """The points that minimise the algebraic error, without gradient, and their status."""
    info, frame, datum = torch.finfo(equations.dtype), equations.frame, equations.datum
    # What the normal matrix loses of the rows' digits matters to those who have them.
    polish = 2 if equations.dtype == torch.float64 else 0

    def product(x: Vector4) -> Vector4:  # a compiler takes no bound method
        return equations.product(x)

    vector, simple = null_vector(
        equations.normal, accuracy=_NEGLIGIBLE * info.eps, product=product, polish=polish
    )
    points = plus(frame.origin, frame.unit / vector[3], vector[:3])
    beside = tuple(place - middle for place, middle in zip(points, frame.middle, strict=True))
    near = (16 * info.eps) ** 2 * dot(beside, beside) <= frame.reach
    x, y, z = in_world(points, datum)
    status = judge(
        finite=frame.finite,
        enough=frame.enough,
        posed=frame.posed & simple,
        near=near & (x.abs() + y.abs() + z.abs() <= info.max),
        in_front=equations.in_front(points),
    )
    return Solution(points, vector), status


def follow_linear(equations: Linear, found: Solution, valid: Tensor) -> Solution:
    """The same, differentiably; finite where not valid."""
    matrix, _ = of_trace_one(equations.normal, valid)
    vector, held = _derivable(matrix, found.vector, valid, equations.frame), equations.frame.held()
    return found._replace(points=plus(held.origin, held.unit / vector[3], vector[:3]))


def of_trace_one(normal: Symmetric4, valid: Tensor) -> tuple[Symmetric4, Tensor]:
    """The matrices divided by their traces, easy ones where not valid; and what they were
    multiplied by, without gradient.
    """
    # Double where: what has failed must pass no gradient and no NaN.
    easy = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0)
    trace = torch.where(valid, trace_of(normal), 1.0).detach()
    # Of trace 1, so that powers of its entries in the gradient neither overflow nor vanish.
    share = trace.reciprocal()
    return scaled(either(valid, normal, easy), share), share


def _derivable(matrix: Symmetric4, vector: Vector4, valid: Tensor, frame: RigFrame) -> Vector4:
    """The null vector, of about unit length, as a function of the matrix and of the frame.

    The matrix is of :func:`of_trace_one`; the vector has any length, and is any where not valid.
    """
    start = of_length_one(vector, valid)
    x0, x1, x2, x3 = rayleigh_step(_measured(matrix, start, valid, frame), start)
    # Below the step's rounding there is no derivative, and not even a sign to divide by.
    lost = start[3].abs() <= 4 * torch.finfo(x3.dtype).eps
    return x0, x1, x2, torch.where(lost, start[3], x3)


def of_length_one(vector: Vector4, valid: Tensor) -> Vector4:
    """Null vectors, without gradient; a place where not valid."""
    held = tuple(component.detach() for component in vector)
    return unit(either(valid, held, (0.0, 0.0, 0.0, 1.0)))


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
    return minus(matrix, mu, norm)


def in_world(points: Vector3, datum: Tensor) -> Vector3:
    """Points in the world, from points relative to the origin of the sums ``(*B, 1, 3)``."""
    return tuple(x + origin for x, origin in zip(points, datum.unbind(dim=-1), strict=True))


def kept(points: Vector3, valid: Tensor) -> Vector3:
    """The valid ones of points three ``(*B, N)``, the others 0."""
    if surely_all(valid):
        return points
    return either(valid, points, (0.0,) * 3)
