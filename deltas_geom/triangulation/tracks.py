"""Triangulation of ragged tracks: many cameras, each point seen by few of them.

What :func:`triangulate` does over a dense V x N, here as one list of observations, each summed
into its point's normal matrix. Memory grows with the observations alone.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import safe_divide, safe_sqrt
from deltas_geom.checks import ShapeError, check_floating, check_index, check_shapes
from deltas_geom.numerics.arithmetic import without_autocast
from deltas_geom.numerics.evaluation import recomputed
from deltas_geom.numerics.ldl import Vector4
from deltas_geom.status import Status
from deltas_geom.triangulation.judge import judge, ok
from deltas_geom.triangulation.observed import Vector3
from deltas_geom.triangulation.solution import (
    FoundPoints,
    derivable_points,
    find_points,
    in_world,
    kept,
)
from deltas_geom.triangulation.track_equations import (
    PosedTracks,
    at,
    pose_tracks,
    project_listed,
    summed,
)


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


@without_autocast
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
        TypeError: an index is not of integers.
        ValueError: ``num_points`` is negative.
        IndexError or RuntimeError: by torch, an index is out of range. (On a GPU torch may tell
            later, or end the process: check lists of unknown origin before they go there.)

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
    check_index(camera_index=camera_index, point_index=point_index)
    check_floating(proj=proj)
    weight = torch.ones_like(pixels[..., 0]) if weights is None else weights
    check_shapes(pixels=(pixels, "T 2"), weights=(weight, "T"))
    # A list has no batch: cameras and points of all scenes may share one list instead.
    for name, tensor, dims in (
        ("proj", proj, ("C", "3", "4")),
        ("pixels", pixels, ("T", "2")),
        ("camera_index", camera_index, ("T",)),
        ("point_index", point_index, ("T",)),
        ("weights", weight, ("T",)),
    ):
        if tensor.dim() != len(dims):
            wanted = f"({', '.join(dims)})"
            raise ShapeError(f"{name} must have shape {wanted}, got {tuple(tensor.shape)}")
    if num_points < 0:
        raise ValueError(f"num_points must not be negative, got {num_points}")

    def known(posed: PosedTracks, points: Vector3, status: Tensor) -> tuple[Tensor, ...]:
        listed, valid = posed.listed, status == Status.OK.value
        ok = at(valid, listed.point)
        x, y, depth = project_listed(listed.camera, at(torch.stack(points), listed.point))
        counts = ~listed.unused & ok
        dx = safe_divide(x, depth, counts) - torch.where(counts, listed.x, 0.0)
        dy = safe_divide(y, depth, counts) - torch.where(counts, listed.y, 0.0)
        squared = torch.where(counts, listed.squared, 0.0)
        errors = summed(squared * (dx * dx + dy * dy), listed.point, num_points)
        total = summed(squared, listed.point, num_points)
        mean = safe_divide(errors, total, total > 0)
        residual = safe_sqrt(mean)
        limit = torch.finfo(proj.dtype).max
        outward = (
            found.to(proj.dtype).clamp(-limit, limit)
            for found in (torch.stack(points, dim=-1), torch.where(ok, depth, 0.0), residual)
        )
        return (*outward, status)

    def values(*inputs: Tensor) -> tuple[Tensor, ...]:
        posed = pose_tracks(*inputs, num_points=num_points)
        found, status = _find(posed)
        points = kept(in_world(found.points, posed.datum), ok(status))
        return known(posed, points, status)

    def derivable(*inputs: Tensor) -> tuple[Tensor, ...]:
        posed = pose_tracks(*inputs, num_points=num_points)
        found, status = _find(posed)
        valid = status == Status.OK.value
        near = derivable_points(posed.normal, posed.frame, found.vector, valid)
        return known(posed, kept(in_world(near, posed.datum), valid), status)

    inputs = (proj, pixels, camera_index.long(), point_index.long(), weight)
    points, depth, residual, status = recomputed(derivable, *inputs, values=values)
    return TriangulatedTracks(points, depth, status, status == Status.OK.value, residual)


@torch.no_grad()
def _find(posed: PosedTracks) -> tuple[FoundPoints, Tensor]:
    """Points and their status, without gradient."""
    listed, count = posed.listed, posed.frame.unit.shape[0]

    def product(x: Vector4) -> Vector4:
        a, b = posed.rows
        place = at(torch.stack(x), listed.point)
        along_a, along_b = (a * place).sum(dim=0), (b * place).sum(dim=0)
        rows = listed.squared * (a * along_a + b * along_b)
        g0, g1, g2, g3 = summed(rows, listed.point, count)
        return g0, g1, g2, g3

    polish = 2 if posed.dtype == torch.float64 else 0
    eps = torch.finfo(posed.dtype).eps
    found = find_points(posed.normal, posed.frame, eps=eps, product=product, polish=polish)
    x, y, z = in_world(found.points, posed.datum)
    _, _, depth = project_listed(listed.camera, at(torch.stack([x, y, z]), listed.point))
    behind = summed((~listed.unused & ~(depth > 0)).to(depth.dtype), listed.point, count)
    held = x.abs() + y.abs() + z.abs() <= torch.finfo(posed.dtype).max
    frame = posed.frame
    status = judge(
        finite=frame.finite,
        enough=frame.enough,
        posed=found.posed,
        near=found.near & held,
        in_front=behind == 0,
    )
    return found, status
