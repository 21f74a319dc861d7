"""Triangulation of ragged tracks: many cameras, each point seen by few of them.

What :func:`triangulate` does over a dense V x N, here as one list of observations, each summed
into its point's normal matrix. Memory grows with the observations alone.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.checks import ShapeError, check_shapes
from deltas_geom.homogeneous import safe_divide
from deltas_geom.null_vector import Symmetric4
from deltas_geom.rays import RigFrame, judge_points, solve_points
from deltas_geom.status import Status
from deltas_geom.uncertainty import projection_centers, solver_dtype

# As in triangulation: squared and times a small parallax, less would be lost in rounding.
_NEGLIGIBLE_WEIGHT = 1e-6


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

    weight = torch.ones_like(pixels[:, 0]) if weights is None else weights
    listed = _listed(proj, pixels, camera_index, point_index, num_points, weight)
    frame = _frame(listed)
    found = solve_points(_normal_matrix(listed, frame), frame, eps=torch.finfo(proj.dtype).eps)

    place = _at(found.points, listed.point)  # (3, T)
    x, y, depth = (listed.camera[:, :3] * place).sum(dim=1) + listed.camera[:, 3]
    behind = _sum((listed.used & ~(depth.detach() > 0)).to(depth.dtype), listed.point, num_points)
    size = torch.maximum(
        found.points.detach().abs().amax(dim=0),
        _largest(depth.detach().abs(), listed.point, num_points),
    )
    status = judge_points(
        found,
        in_front=behind == 0,
        size=size,
        largest=torch.finfo(proj.dtype).max,
        enough=listed.enough,
        finite=listed.finite,
    )
    valid = status == Status.OK
    ok = _at(valid, listed.point)
    counts = listed.used & ok
    dx = safe_divide(x, depth, counts) - torch.where(counts, listed.x, 0.0)
    dy = safe_divide(y, depth, counts) - torch.where(counts, listed.y, 0.0)
    errors = _sum(listed.squared * (dx * dx + dy * dy), listed.point, num_points)
    mean = safe_divide(errors, listed.total, valid & (listed.total > 0))
    positive = valid & (mean > 0)
    # sqrt has an infinite slope at a perfect match; its gradient there is taken as 0.
    residual = torch.where(positive, torch.where(positive, mean, 1.0).sqrt(), 0.0)
    return TriangulatedTracks(
        points=torch.where(valid, found.points, 0.0).mT.to(proj.dtype),
        depth=torch.where(ok, depth, 0.0).to(proj.dtype),
        status=status,
        valid=valid,
        residual=residual.to(proj.dtype),
    )


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
        center: ``(3, T)`` of the camera.
        x: ``(T)`` px, 0 where unused.
        y: ``(T)``.
        squared: ``(T)`` squared weights, a point's largest 1; 0 where unused.
        used: ``(T)`` of points that may be solvable.
        counts: ``(T)`` the weight is not negligible beside the point's largest.
        point: ``(T)`` index.
        total: ``(N)`` sum of the squared weights.
        finite: ``(N)`` everything used is.
        enough: ``(N)`` at least two observations count.
    """

    camera: Tensor
    center: Tensor
    x: Tensor
    y: Tensor
    squared: Tensor
    used: Tensor
    counts: Tensor
    point: Tensor
    total: Tensor
    finite: Tensor
    enough: Tensor


def _listed(
    proj: Tensor,
    pixels: Tensor,
    camera_index: Tensor,
    point_index: Tensor,
    num_points: int,
    weights: Tensor,
) -> _Listed:
    work = solver_dtype(proj)
    camera_index, point_index = camera_index.long(), point_index.long()
    x, y = pixels.to(work).unbind(dim=-1)
    weight = weights.to(work)
    known_camera = proj.isfinite().all(-1).all(-1)
    known = x.isfinite() & y.isfinite() & weight.isfinite() & _at(known_camera, camera_index)
    used = weight != 0  # NaN counts as used, and is caught as not finite
    wrong = _sum((used & ~known).to(work), point_index, num_points)
    size = torch.where(used & known, weight.detach().abs(), 0.0)
    largest = _at(_largest(size, point_index, num_points), point_index)
    counts = used & (size > _NEGLIGIBLE_WEIGHT * largest)
    enough = _sum(counts.to(work), point_index, num_points) >= 2
    finite = wrong == 0
    used = used & _at(finite & enough, point_index)
    share = weight / torch.where(largest > 0, largest, 1.0)

    # Double where throughout: what is not used must pass no gradient and no NaN.
    squared = torch.where(used, share, 0.0).square()
    camera = torch.where(known_camera[:, None, None], proj, 0.0).to(work)
    centers, _ = projection_centers(camera)
    return _Listed(
        camera=_at(camera.permute(1, 2, 0), camera_index),
        center=_at(centers.mT, camera_index),
        x=torch.where(used, x, 0.0),
        y=torch.where(used, y, 0.0),
        squared=squared,
        used=used,
        counts=counts,
        point=point_index,
        total=_sum(squared, point_index, num_points),
        finite=finite,
        enough=enough,
    )


def _frame(listed: _Listed) -> RigFrame:
    point, count = listed.point, listed.total.shape[0]
    total = _at(listed.total, point)
    share = safe_divide(listed.squared, total, total > 0)
    # Its rounding, far from the world's origin, does no harm: any origin near by will do.
    origin = _sum(share * listed.center, point, count)
    apart = (listed.center - _at(origin, point)).square().sum(dim=0)
    variance = _sum(share * apart, point, count)
    unit = torch.where(variance > torch.finfo(variance.dtype).tiny, variance, 1.0).sqrt()
    reach = _largest(torch.where(listed.counts, apart.detach(), 0.0), point, count).sqrt()
    from_world = listed.center.detach().square().sum(dim=0)
    farthest = _largest(torch.where(listed.counts, from_world, 0.0), point, count).sqrt()
    return RigFrame(origin, unit, reach, farthest, listed.finite & listed.enough)


def _normal_matrix(listed: _Listed, frame: RigFrame) -> Symmetric4:
    """A^T W^2 A of the DLT rows x p3 - p1, y p3 - p2 in each point's frame, as ten ``(N)``."""
    origin, unit = _at(frame.origin, listed.point), _at(frame.unit, listed.point)
    moved = ((listed.camera[:, :3] * origin).sum(dim=1) + listed.camera[:, 3]) / unit
    p1, p2, p3 = torch.cat([listed.camera[:, :3], moved[:, None]], dim=1)  # each (4, T)
    a, b = listed.x * p3 - p1, listed.y * p3 - p2
    wa, wb = listed.squared * a, listed.squared * b
    entries = torch.stack(
        [torch.addcmul(wa[i] * a[j], wb[i], b[j]) for i in range(4) for j in range(i, 4)]
    )
    sums = _sum(entries, listed.point, listed.total.shape[0])
    m00, m01, m02, m03, m11, m12, m13, m22, m23, m33 = sums.unbind(dim=0)
    return m00, m01, m02, m03, m11, m12, m13, m22, m23, m33
