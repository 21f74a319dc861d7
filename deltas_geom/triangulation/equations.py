"""The equations that observations put to points, in frames where they are easy to solve."""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from deltas_geom.numerics.ldl import Symmetric4, Vector4, dot, multiply, unit
from deltas_geom.numerics.null_vector import solve_in_complement
from deltas_geom.triangulation.dlt import alike_coefficients, alike_normal_matrix, normal_matrix
from deltas_geom.triangulation.observed import (
    Cameras,
    Observations,
    Vector3,
    Weights,
    alike_weights,
    cameras_of,
    check_pixels,
    clean_pixels,
    over_views,
    weigh_pixels,
)
from deltas_geom.triangulation.rig_frame import (
    RigFrame,
    derivable_vector,
    in_frame,
    of_trace_one,
    rig_frames,
)


class Posed(NamedTuple):
    """The points' equations, in frames where they are easy.

    Attributes:
        observed: what was seen.
        around: ``(*B, 1, 3)`` the origin of the sums, in the world.
        proj: ``(*B, V, 3, 4)`` of points relative to it.
        centers: ``(*B, V, 3)`` of the cameras, in the world.
        frame: of the points.
        normal: ten ``(*B, N)``, in the frame.
        dtype: of the inputs.
    """

    observed: Observations
    around: Tensor
    proj: Tensor
    centers: Tensor
    frame: RigFrame
    normal: Symmetric4
    dtype: torch.dtype


class Alike(NamedTuple):
    """Cameras of points that all weigh the same, and the one frame of these.

    Attributes:
        cameras: in the solver's type.
        weights: of one point for all.
        around: see :class:`Posed`.
        near: its ``proj``.
        frame: of one point for all.
        coefficients: of the normal matrix in the frame.
    """

    cameras: Cameras
    weights: Weights
    around: Tensor
    near: Tensor
    frame: RigFrame
    coefficients: Tensor


def prepared(
    proj: Tensor, weights: Tensor | None, mask: Tensor | None, *, kind: str
) -> Cameras | Alike:
    """What :func:`pose` needs that does not depend on any point.

    Args:
        proj: ``(*B, V, 3, 4)``.
        weights: see :func:`deltas_geom.triangulation.observed.weigh`.
        mask: see there.
        kind: of the frames, "rig" or "world".
    """
    cameras = cameras_of(proj)
    if weights is not None or mask is not None:
        return cameras
    alike = alike_weights(cameras.proj)
    around, near, frame = _frames(cameras, alike, kind, proj.dtype)
    # Few cameras are moved, not every matrix.
    coefficients = alike_coefficients(_cameras_in_frame(near, frame), alike.squared)
    return Alike(cameras, alike, around, near, frame, coefficients)


def pose(
    known: Cameras | Alike,
    pixels: Tensor,
    weights: Tensor | None,
    mask: Tensor | None,
    *,
    kind: str,
    dtype: torch.dtype,
) -> Posed:
    """The equations of points.

    Args:
        known: of :func:`prepared`.
        pixels: ``(*B, V, N, 2)``; those of unused views may hold anything.
        weights: as for :func:`prepared`.
        mask: as for :func:`prepared`.
        kind: as for :func:`prepared`.
        dtype: of the cameras, before.
    """
    if isinstance(known, Alike):
        return _pose_alike(known, pixels, dtype)
    cameras = known
    xy, weighed = weigh_pixels(cameras, pixels, weights, mask)
    around, near, frame = _frames(cameras, weighed, kind, dtype)
    x, y = xy.unbind(dim=-2)
    normal = _ten(normal_matrix(near, x, y, weighed.squared))
    normal = in_frame(normal, frame.origin, frame.unit)
    observed = Observations(cameras.proj, cameras.sick, xy, weighed)
    return Posed(observed, around, near, cameras.centers, frame, normal, dtype)


def _pose_alike(known: Alike, pixels: Tensor, dtype: torch.dtype) -> Posed:
    cameras, weights, around, near, frame, coefficients = known
    check_pixels(cameras, pixels)
    xy, sound = clean_pixels(pixels)
    normal = _ten(alike_normal_matrix(coefficients, xy))
    sound = sound.all(dim=-2)
    observed = Observations(
        cameras.proj, cameras.sick, xy, weights._replace(sound=weights.sound & sound)
    )
    frame = frame._replace(finite=frame.finite & sound)
    return Posed(observed, around, near, cameras.centers, frame, normal, dtype)


def _frames(
    cameras: Cameras, weights: Weights, kind: str, dtype: torch.dtype
) -> tuple[Tensor, Tensor, RigFrame]:
    """The origin of the sums, cameras of points relative to it, and the frames of points."""
    around, frame = rig_frames(cameras.centers, weights, cameras.sick, eps=torch.finfo(dtype).eps)
    rows = cameras.proj[..., :3]
    moved = cameras.proj[..., 3:] + rows @ around.unsqueeze(-3).mT
    near = torch.cat([rows.expand(*moved.shape[:-1], 3), moved], dim=-1)
    if kind == "world":
        ox, oy, oz = (-middle.expand_as(frame.unit) for middle in around.unbind(dim=-1))
        frame = frame._replace(origin=(ox, oy, oz), unit=torch.ones_like(frame.unit))
    return around, near, frame


def _ten(entries: tuple[Tensor, ...]) -> Symmetric4:
    m00, m01, m02, m03, m11, m12, m13, m22, m23, m33 = entries
    return m00, m01, m02, m03, m11, m12, m13, m22, m23, m33


def _cameras_in_frame(proj: Tensor, frame: RigFrame) -> Tensor:
    """P T of cameras ``(*B, V, 3, 4)``, where :func:`in_frame` takes M to T^T M T."""
    rows = proj[..., :3]
    origin = torch.stack(frame.origin, dim=-2).unsqueeze(-3)  # (*B, 1, 3, 1)
    last = (rows @ origin + proj[..., 3:]) / frame.unit[..., None, None]
    return torch.cat([rows.expand(*last.shape[:-1], 3), last], dim=-1)


def product_of(posed: Posed, v: Vector4) -> Vector4:
    """A^T W^2 (A v) of the equations in the frame: the normal matrix times v, unsquared."""
    p, squared = posed.proj, posed.observed.weights.squared
    x, y = posed.observed.xy.unbind(dim=-2)
    across, down = (error * squared for error in _errors(posed, v))
    sums = torch.stack([-across, -down, x * across + y * down], dim=-2).flatten(-3, -2)
    g0, g1, g2, g3 = over_views(p.flatten(-3, -2).mT, sums)
    ox, oy, oz = posed.frame.origin
    return g0, g1, g2, (ox * g0 + oy * g1 + oz * g2 + g3) / posed.frame.unit


def _errors(posed: Posed, v: Vector4) -> tuple[Tensor, Tensor]:
    """A v of the equations in the frame: two ``(*B, V, N)``."""
    place = _out_of_frame(posed.frame, v)
    x, y = posed.observed.xy.unbind(dim=-2)
    a, b, c = (_homogeneous_in_views(posed.proj[..., row, :], place) for row in range(3))
    return x * c - a, y * c - b


def _out_of_frame(frame: RigFrame, v: Vector4) -> Vector4:
    """T v, where :func:`in_frame` takes M to T^T M T."""
    (ox, oy, oz), w = frame.origin, v[3] / frame.unit
    return torch.addcmul(v[0], ox, w), torch.addcmul(v[1], oy, w), torch.addcmul(v[2], oz, w), w


def _homogeneous_in_views(row: Tensor, points: Vector4) -> Tensor:
    total = row[..., 3, None] * points[3].unsqueeze(-2)
    for axis in range(3):
        total = torch.addcmul(total, row[..., axis, None], points[axis].unsqueeze(-2))
    return total


def lagrangian_of(posed: Posed, place: Vector3, valid: Tensor, gradient: Vector3) -> Tensor:
    """What changes with the equations as the sum of gradient * points does, to first order.

    A change dM of the normal matrix changes its null vector x by -(M - mu)^+ dM x, and with it a
    sum whose gradient by x is g by -y^T dM x, y = (M - mu)^+ g. Held x and y, the derivative of
    y^T M x is a product of the errors of both: nothing of how x was found is derived.

    Args:
        posed: differentiable.
        place: the points in the frame, in units of it; anything where not valid.
        valid: ``(*B, N)`` bool.
        gradient: three ``(*B, N)`` by the points.

    Returns:
        ``(*B, N)``, whose value means nothing.
    """
    frame = posed.frame
    with torch.no_grad():
        matrix, share = of_trace_one(posed.normal, valid)
        one, zero = torch.ones_like(share), share.new_zeros(())
        # What was kept of the vector is rounded; the step takes it to the solver's rounding.
        x0, x1, x2, x3 = derivable_vector(matrix, (*place, one), valid)
        g0, g1, g2 = (torch.where(valid, component, zero) for component in gradient)
        d0, d1, d2 = x0 / x3, x1 / x3, x2 / x3
        x = unit((x0, x1, x2, x3))
        scale = frame.unit * share / x[3]
        of_x = (g0 * scale, g1 * scale, g2 * scale, -(g0 * d0 + g1 * d1 + g2 * d2) * scale)
        y = solve_in_complement(matrix, x, dot(x, multiply(matrix, x)), of_x)
    ox, oy, oz = frame.origin
    moved = g0 * (frame.unit * d0 + ox) + g1 * (frame.unit * d1 + oy) + g2 * (frame.unit * d2 + oz)
    return moved - _product_of_errors(posed, y, x)


def _product_of_errors(posed: Posed, u: Vector4, v: Vector4) -> Tensor:
    """u^T A^T W^2 A v of the equations in the frame."""
    squared = posed.observed.weights.squared
    if not torch.compiler.is_compiling():
        (across, down), (along, below) = _errors(posed, u), _errors(posed, v)
        return (squared * (across * along + down * below)).sum(dim=-2)
    # View by view, which a compiler fuses with what stands around it.
    rows = posed.proj.flatten(-3, -2)
    first, second = (
        _FusedProduct.apply(rows, *_out_of_frame(posed.frame, z))  # type: ignore[no-untyped-call]
        for z in (u, v)
    )
    total = torch.zeros_like(u[0])
    for view in range(squared.shape[-2]):
        x, y = posed.observed.xy[..., view, :, :].unbind(dim=-2)
        (a, b, c), (d, e, f) = (rows[3 * view : 3 * view + 3] for rows in (first, second))
        product = torch.addcmul((x * c - a) * (x * f - d), y * c - b, y * f - e)
        total = torch.addcmul(total, squared[..., view, :], product)
    return total


class _FusedProduct(torch.autograd.Function):
    """Matrices ``(*B, K, 4)`` times vectors, for which nothing is stacked; backward by rows."""

    @staticmethod
    def forward(rows: Tensor, v0: Tensor, v1: Tensor, v2: Tensor, v3: Tensor) -> tuple[Tensor, ...]:
        return tuple(_linear(row, (v0, v1, v2, v3)) for row in rows.unbind(dim=-2))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Any) -> None:
        ctx.save_for_backward(*inputs)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, ...]:
        rows, *v = ctx.saved_tensors
        of_rows = torch.stack(gradients, dim=-2) @ torch.stack(v, dim=-2).mT
        of_v = (_linear(column, gradients) for column in rows.unbind(dim=-1))
        return of_rows.sum_to_size(rows.shape), *of_v


def _linear(factors: Tensor, values: tuple[Tensor, ...]) -> Tensor:
    parts = [f.unsqueeze(-1) * v for f, v in zip(factors.unbind(-1), values, strict=True)]
    return sum(parts[1:], parts[0])


def columns_of(observed: Observations) -> Vector4:
    """Columns ``(*B, 2 V, N)`` of the weighted equations in the world."""
    weight = observed.weights.squared.sqrt().unsqueeze(-2)
    xy = observed.xy * weight
    c0, c1, c2, c3 = (
        torch.addcmul(xy * p[..., 2:, :], weight, p[..., :2, :], value=-1).flatten(-3, -2)
        for p in observed.proj.unsqueeze(-1).unbind(dim=-2)
    )
    return c0, c1, c2, c3
