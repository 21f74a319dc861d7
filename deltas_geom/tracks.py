"""Triangulation of ragged tracks: many cameras, each point seen by few of them.

What :func:`triangulate` does over a dense V x N, here as one list of observations, each summed
into its point's normal matrix. Memory grows with the observations alone.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.checks import ShapeError, check_shapes
from deltas_geom.homogeneous import safe_divide
from deltas_geom.ldl import Symmetric4, Vector4
from deltas_geom.observations import (
    NEGLIGIBLE_WEIGHT,
    Vector3,
    projection_centers,
    solver_dtype,
)
from deltas_geom.recompute import recomputed
from deltas_geom.rig_frame import (
    FoundPoints,
    RigFrame,
    camera_moments,
    derivable_points,
    find_points,
    in_world,
    judge_points,
    kept,
    rig_frame,
)
from deltas_geom.status import Status


class TriangulatedTracks(NamedTuple):
    """Triangulated points and what is known about them.

    Attributes:
        points: ``(N, 3)`` in the world, metres; (0, 0, 0) with zero gradient if not valid.
        depth: ``(T)`` of each observation's point along its camera's z axis, metres; 0 if the
            point is not valid.
        status: ``(N)`` int8 of :class:`Status`.
        valid: ``(N)`` bool, status is OK.
        residual: ``(N)`` weighted RMS distance of the projections from the pixels, px.
    """

    points: Tensor
    depth: Tensor
    status: Tensor
    valid: Tensor
    residual: Tensor


def triangulate_tracks(
    proj: Tensor,
    pixels: Tensor,
    camera_index: Tensor,
    point_index: Tensor,
    num_points: int,
    weights: Tensor | None = None,
) -> TriangulatedTracks:
    """Triangulate N points from T observations by C cameras, differentiably.

    The answer is that of :func:`triangulate` with the tracks padded. The order of observations
    does not count. Two observations of a point by one camera are two views without a baseline.

    Args:
        proj: ``(C, 3, 4)`` K [R | t].
        pixels: ``(T, 2)``; those of unused observations may hold anything.
        camera_index: ``(T)`` integers, 0 to C - 1.
        point_index: ``(T)`` integers, 0 to N - 1.
        num_points: N. A point without observations has the status TOO_FEW_VIEWS.
        weights: ``(T)`` not negative (a sign has no effect). 0 = unused.

    Returns:
        Points with status. Nothing raises or turns NaN because of pixels, weights or cameras.

    Raises:
        ShapeError: a shape differs.
        ValueError: ``num_points`` is negative.
        IndexError or RuntimeError: by torch, an index is out of range.

    Source: Hartley and Zisserman, 2nd ed., section 12.2.

    Example:
        >>> left = torch.tensor([[100.0, 0, 50, 0], [0, 100, 40, 0], [0, 0, 1, 0]])
        >>> right = left.clone()
        >>> right[0, 3] = -20.0  # 20 cm to the right
        >>> tracks = triangulate_tracks(
        ...     torch.stack([left, right]),
        ...     pixels=torch.tensor([[60.0, 45.0], [50.0, 45.0], [7.0, 7.0]]),
        ...     camera_index=torch.tensor([0, 1, 0]),
        ...     point_index=torch.tensor([0, 0, 1]),
        ...     num_points=2,
        ... )
        >>> tracks.points.round(decimals=3)
        tensor([[0.2000, 0.1000, 2.0000],
                [0.0000, 0.0000, 0.0000]])
        >>> Status(tracks.status[1].item()).name
        'TOO_FEW_VIEWS'
    """
    check_shapes(
        proj=(proj, "C 3 4"),
        pixels=(pixels, "T 2"),
        camera_index=(camera_index, "T"),
        point_index=(point_index, "T"),
    )
    if weights is not None:
        check_shapes(pixels=(pixels, "T 2"), weights=(weights, "T"))
    # A list has no batch: cameras and points of all scenes may share one list instead.
    for name, tensor, dims in (("proj", proj, "C, 3, 4"), ("pixels", pixels, "T, 2")):
        if tensor.dim() != dims.count(",") + 1:
            raise ShapeError(f"{name} must have shape ({dims}), got {tuple(tensor.shape)}")
    if num_points < 0:
        raise ValueError(f"num_points must not be negative, got {num_points}")

    def known(posed: _Posed, points: Vector3, status: Tensor) -> tuple[Tensor, ...]:
        listed, valid = posed.listed, status == Status.OK.value
        ok = _at(valid, listed.point)
        x, y, depth = _project(listed.camera, _at(torch.stack(points), listed.point))
        counts = ~listed.unused & ok
        dx = safe_divide(x, depth, counts) - torch.where(counts, listed.x, 0.0)
        dy = safe_divide(y, depth, counts) - torch.where(counts, listed.y, 0.0)
        squared = torch.where(counts, listed.squared, 0.0)
        errors = _sum(squared * (dx * dx + dy * dy), listed.point, num_points)
        total = _sum(squared, listed.point, num_points)
        mean = safe_divide(errors, total, total > 0)
        positive = mean > 0
        # sqrt has an infinite slope at a perfect match; its gradient there is taken as 0.
        residual = torch.where(positive, torch.where(positive, mean, 1.0).sqrt(), 0.0)
        limit = torch.finfo(proj.dtype).max
        outward = (
            found.to(proj.dtype).clamp(-limit, limit)
            for found in (torch.stack(points, dim=-1), torch.where(ok, depth, 0.0), residual)
        )
        return (*outward, status)

    def values(*inputs: Tensor) -> tuple[Tensor, ...]:
        posed = _pose(*inputs, num_points=num_points)
        found, status = _find(posed)
        points = kept(found.points, posed.around, status == Status.OK.value)
        return known(posed, points, status)

    def derivable(*inputs: Tensor) -> tuple[Tensor, ...]:
        posed = _pose(*inputs, num_points=num_points)
        found, status = _find(posed)
        valid = status == Status.OK.value
        near = derivable_points(posed.normal, posed.frame, found.vector, valid)
        return known(posed, kept(near, posed.around, valid), status)

    weight = torch.ones_like(pixels[:, 0]) if weights is None else weights
    inputs = (proj, pixels, camera_index.long(), point_index.long(), weight)
    points, depth, residual, status = recomputed(derivable, *inputs, values=values)
    return TriangulatedTracks(points, depth, status, status == Status.OK.value, residual)


def _sum(values: Tensor, index: Tensor, count: int) -> Tensor:
    """Sums ``(*K, N)`` over observations ``(*K, T)`` of each point."""
    return values.new_zeros(*values.shape[:-1], count).index_add(-1, index, values)


def _largest(values: Tensor, index: Tensor, count: int) -> Tensor:
    """Largest of non-negative ``(T)`` over each point's observations, ``(N)``; 0 if none."""
    return values.new_zeros(count).scatter_reduce(0, index, values, "amax")


def _at(values: Tensor, index: Tensor) -> Tensor:
    """``(*K, T)``: of each observation, the value ``(*K, N)`` of its point or camera."""
    return values.index_select(-1, index)


class _Listed(NamedTuple):
    """Observations in the solver's type, with everything unusable replaced.

    Attributes:
        camera: ``(3, 4, T)`` projection matrix.
        x: ``(T)`` px, 0 where not finite.
        y: ``(T)``.
        squared: ``(T)`` squared weights, a point's largest 1; 0 where unused or not finite.
        unused: ``(T)`` bool.
        point: ``(T)`` index.
        sound: ``(N)`` bool: every used pixel and weight is finite.
    """

    camera: Tensor
    x: Tensor
    y: Tensor
    squared: Tensor
    unused: Tensor
    point: Tensor
    sound: Tensor


class _Posed(NamedTuple):
    """The points' equations, in their frames.

    Attributes:
        listed: the observations.
        rows: x p3 - p1 and y p3 - p2 in the frame, each four ``(T)``.
        around: ``(1, 3)`` the origin of the sums, in the world.
        frame: of the points.
        normal: ten ``(N)``, in the frame.
        dtype: of the inputs.
    """

    listed: _Listed
    rows: tuple[Tensor, Tensor]
    around: Tensor
    frame: RigFrame
    normal: Symmetric4
    dtype: torch.dtype


def _pose(
    proj: Tensor,
    pixels: Tensor,
    camera_index: Tensor,
    point_index: Tensor,
    weights: Tensor,
    *,
    num_points: int,
) -> _Posed:
    work = solver_dtype(proj)
    finite = (proj.detach().to(work).abs() < torch.finfo(work).max ** 0.25).all(-1).all(-1)
    camera = torch.where(finite[:, None, None], proj, 0.0).to(work)
    listed = _listed(camera, pixels, camera_index, point_index, num_points, weights)

    centers = projection_centers(camera)
    # Of all cameras alike: those that see nothing do no harm beyond rounding.
    around = centers.detach().mean(dim=0, keepdim=True)
    weighted, counted = camera_moments(centers, around, (~finite).to(work))
    frame = rig_frame(
        _sum(_at(weighted, camera_index) * listed.squared, point_index, num_points).unbind(),
        _sum(
            torch.where(listed.unused, 0.0, _at(counted, camera_index)), point_index, num_points
        ).unbind(),
        eps=torch.finfo(proj.dtype).eps,
    )
    frame = frame._replace(finite=frame.finite & listed.sound)
    origin = _at(torch.stack(frame.origin), point_index) + around.mT
    unit = _at(frame.unit, point_index)
    moved = ((listed.camera[:, :3] * origin).sum(dim=1) + listed.camera[:, 3]) / unit
    p1, p2, p3 = torch.cat([listed.camera[:, :3], moved[:, None]], dim=1)  # each (4, T)
    rows = listed.x * p3 - p1, listed.y * p3 - p2
    normal = _normal_matrix(rows, listed.squared, point_index, num_points)
    return _Posed(listed, rows, around, frame, normal, proj.dtype)


def _listed(
    camera: Tensor,
    pixels: Tensor,
    camera_index: Tensor,
    point_index: Tensor,
    num_points: int,
    weights: Tensor,
) -> _Listed:
    x, y = pixels.to(camera.dtype).unbind(dim=-1)
    weight = weights.to(camera.dtype)
    with torch.no_grad():
        size = weight.abs()
        # What is beyond overflows; NaN is not below.
        sound = (x * x + y * y < torch.finfo(x.dtype).max ** 0.25) & (
            size <= torch.finfo(x.dtype).max
        )
        # NaN counts as used.
        largest = _at(_largest(size.nan_to_num(0.0), point_index, num_points), point_index)
        unused = size <= NEGLIGIBLE_WEIGHT * largest
        wrong = _sum((~(sound | unused)).to(x.dtype), point_index, num_points)
        largest = torch.where((largest > 0) & largest.isfinite(), largest, 1.0)
    # Double where: what is not used must pass no gradient and no NaN.
    share = torch.where(sound, weight, 0.0) / largest
    return _Listed(
        camera=_at(camera.permute(1, 2, 0), camera_index),
        x=torch.where(sound, x, 0.0),
        y=torch.where(sound, y, 0.0),
        squared=torch.where(unused, 0.0, share * share),
        unused=unused,
        point=point_index,
        sound=wrong == 0,
    )


def _normal_matrix(
    rows: tuple[Tensor, Tensor], squared: Tensor, point: Tensor, count: int
) -> Symmetric4:
    """A^T W^2 A as ten ``(N)``."""
    a, b = rows
    wa, wb = squared * a, squared * b
    entries = torch.stack(
        [torch.addcmul(wa[i] * a[j], wb[i], b[j]) for i in range(4) for j in range(i, 4)]
    )
    m00, m01, m02, m03, m11, m12, m13, m22, m23, m33 = _sum(entries, point, count).unbind(dim=0)
    return m00, m01, m02, m03, m11, m12, m13, m22, m23, m33


@torch.no_grad()
def _find(posed: _Posed) -> tuple[FoundPoints, Tensor]:
    """Points and their status, without gradient."""
    listed, count = posed.listed, posed.frame.unit.shape[0]

    def product(x: Vector4) -> Vector4:
        a, b = posed.rows
        place = _at(torch.stack(x), listed.point)
        along_a, along_b = (a * place).sum(dim=0), (b * place).sum(dim=0)
        rows = listed.squared * (a * along_a + b * along_b)
        g0, g1, g2, g3 = _sum(rows, listed.point, count)
        return g0, g1, g2, g3

    polish = 2 if posed.dtype == torch.float64 else 0
    eps = torch.finfo(posed.dtype).eps
    found = find_points(posed.normal, posed.frame, eps=eps, product=product, polish=polish)
    x, y, z = in_world(found.points, posed.around)
    _, _, depth = _project(listed.camera, _at(torch.stack([x, y, z]), listed.point))
    behind = _sum((~listed.unused & ~(depth > 0)).to(depth.dtype), listed.point, count)
    held = x.abs() + y.abs() + z.abs() <= torch.finfo(posed.dtype).max
    status = judge_points(found, posed.frame, in_front=behind == 0, representable=held)
    return found, status


def _project(camera: Tensor, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Homogeneous pixels of points ``(3, T)`` in cameras ``(3, 4, T)``, each ``(T)``."""
    x, y, depth = (camera[:, :3] * points).sum(dim=1) + camera[:, 3]
    return x, y, depth
