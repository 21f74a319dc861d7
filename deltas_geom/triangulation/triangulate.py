"""Weighted, masked n-view DLT triangulation; every point carries a Status.

Each point is solved in its own rig frame (rig_frame.py), in float64 whatever the input, where the
device has it. Backward keeps the inputs, for points alone also the points, and computes the rest
again.
"""

from typing import Literal, NamedTuple

import torch
from torch import Tensor

from deltas_geom.numerics.arithmetic import without_autocast
from deltas_geom.numerics.chunks import in_chunks, surely_all
from deltas_geom.numerics.evaluation import WithLagrangian
from deltas_geom.numerics.ldl import Vector4
from deltas_geom.status import Status
from deltas_geom.triangulation.equations import (
    Alike,
    Posed,
    columns_of,
    lagrangian_of,
    pose,
    prepared,
    product_of,
)
from deltas_geom.triangulation.observed import Cameras, Observations, Vector3, check_observed
from deltas_geom.triangulation.reprojection import in_views, parallax_of, reproject, residual_of
from deltas_geom.triangulation.results import Triangulation
from deltas_geom.triangulation.rig_frame import (
    FoundPoints,
    derivable_points,
    find_points,
    in_world,
    judge_points,
    kept,
    kept_in_world,
)
from deltas_geom.triangulation.uncertainty import covariance_of, representable, unpacked3


@without_autocast
def triangulate_points(
    proj: Tensor,
    pixels: Tensor,
    weights: Tensor | None = None,
    mask: Tensor | None = None,
    *,
    frame: Literal["rig", "world"] = "rig",
) -> Tensor:
    """Points ``(*B, N, 3)`` alone; see :func:`triangulate`, which also says which are valid.

    (0, 0, 0) stands for no answer, and may be one.
    """
    _check_frame(frame)
    check_observed(proj, pixels, weights, mask)

    def prepare(proj: Tensor) -> Cameras | Alike:
        return prepared(proj, weights, mask, kind=frame)

    def values(known: Cameras | Alike, pixels: Tensor, *used: Tensor | None) -> tuple[Tensor, ...]:
        posed = pose(known, pixels, *used, kind=frame, dtype=proj.dtype)
        found, places, status = _find(posed, frame)
        valid = status == Status.OK.value
        points = _outward(kept_in_world(places, valid), proj.dtype)
        return points, _places_in_frame(found, proj.dtype), valid

    def derivable(proj: Tensor, pixels: Tensor, *used: Tensor | None) -> tuple[Tensor, ...]:
        posed = pose(prepare(proj), pixels, *used, kind=frame, dtype=proj.dtype)
        found, _, status = _find(posed, frame)
        valid = status == Status.OK.value
        near = derivable_points(posed.normal, posed.frame, found.vector, valid)
        points = _outward(kept(near, posed.around, valid), proj.dtype)
        return points, _places_in_frame(found, proj.dtype), valid

    def lagrangian(found: tuple[Tensor, ...], gradient: Tensor, *tensors: Tensor | None) -> Tensor:
        cameras, pixels, *used = tensors
        assert cameras is not None and pixels is not None
        posed = pose(prepare(cameras), pixels, *used, kind=frame, dtype=cameras.dtype)
        places, valid = found
        x, y, z = places.to(posed.around.dtype).unbind(dim=-2)
        gx, gy, gz = gradient.to(posed.around.dtype).unbind(dim=-1)
        return lagrangian_of(posed, (x, y, z), valid, (gx, gy, gz))

    points = ((pixels, -2), (weights, -1), (mask, -1))
    function = WithLagrangian(derivable, lagrangian)
    return in_chunks(function, values, proj, points, dims=(-2, -1, -1), prepare=prepare)[0]


@without_autocast
def triangulate(
    proj: Tensor,
    pixels: Tensor,
    weights: Tensor | None = None,
    mask: Tensor | None = None,
    *,
    frame: Literal["rig", "world"] = "rig",
    covariance: bool = False,
) -> Triangulation:
    """Triangulate matched pixels of V views by weighted DLT, differentiably.

    Args:
        proj: ``(*B, V, 3, 4)`` K [R | t].
        pixels: ``(*B, V, N, 2)`` matches; those of unused views may hold anything.
        weights: ``(*B, V, N)`` not negative (a sign has no effect: the rows they multiply are
            squared). 0 = unused.
        mask: ``(*B, V, N)`` bool, True = used.
        frame: "rig" solves in each point's rig frame; "world" in the frame of ``proj``, as
            OpenCV and kornia do, whose answer depends on the world's origin and unit.
        covariance: also compute the covariance of the points.

    Returns:
        Points with status, in the dtype of ``proj``. Nothing raises or turns NaN because of values.

    Raises:
        ShapeError: a trailing shape differs, or there is no view.
        TypeError: ``proj`` is not floating point, or the mask not bool.

    Source: Hartley and Zisserman, 2nd ed., section 12.2; weights as in the paper, section
    3.2, after Iskakov et al. (2019).

    Example:
        >>> left = torch.tensor([[100.0, 0, 50, 0], [0, 100, 40, 0], [0, 0, 1, 0]])
        >>> right = left.clone()
        >>> right[0, 3] = -20.0  # 20 cm to the right
        >>> pixels = torch.tensor([[[60.0, 40.0]], [[50.0, 40.0]]])
        >>> result = triangulate(torch.stack([left, right]), pixels)
        >>> result.points.round(decimals=3)
        tensor([[0.2000, 0.0000, 2.0000]])
    """
    _check_frame(frame)
    check_observed(proj, pixels, weights, mask)

    def described(solved: _Solved) -> tuple[Tensor, ...]:
        observed, valid = solved.observed, solved.status == Status.OK.value
        used = ~observed.weights.unused & valid.unsqueeze(-2)
        seen = reproject(observed.proj, solved.points, used)
        limit = torch.finfo(proj.dtype).max
        found: tuple[Tensor, ...] = (
            torch.stack(solved.points, dim=-1),
            torch.where(valid.unsqueeze(-2), seen.depth, 0.0),
            residual_of(seen, observed.xy, observed.weights.squared),
            parallax_of(solved.centers, solved.points, used.to(seen.x.dtype)),
        )
        outward = tuple(tensor.to(proj.dtype).clamp(-limit, limit) for tensor in found)
        if covariance:
            noise = unpacked3(covariance_of(observed.proj, seen, observed.weights.squared))
            unit = observed.weights.largest.squeeze(-2)[..., None, None]
            # Divided twice: the square of a small weight may be 0.
            outward = (*outward, representable(noise / unit / unit, proj.dtype))
        return (*outward, solved.status)

    def prepare(proj: Tensor) -> Cameras | Alike:
        return prepared(proj, weights, mask, kind=frame)

    def values(known: Cameras | Alike, pixels: Tensor, *used: Tensor | None) -> tuple[Tensor, ...]:
        return described(_values(pose(known, pixels, *used, kind=frame, dtype=proj.dtype), frame))

    def derivable(proj: Tensor, pixels: Tensor, *used: Tensor | None) -> tuple[Tensor, ...]:
        posed = pose(prepare(proj), pixels, *used, kind=frame, dtype=proj.dtype)
        return described(_derivable(posed, frame))

    dims = (-2, -1, -1, -1, *([-3] if covariance else []), -1)
    points = ((pixels, -2), (weights, -1), (mask, -1))
    found = in_chunks(derivable, values, proj, points, dims=dims, prepare=prepare)
    places, depth, residual, parallax, *noise, status = found
    valid = status == Status.OK.value
    return Triangulation(
        places, depth, status, valid, residual, parallax, noise[0] if noise else None
    )


class _Solved(NamedTuple):
    """Points before they leave the solver's type and layout.

    Attributes:
        observed: what was seen.
        centers: ``(*B, V, 3)`` of the cameras.
        points: three ``(*B, N)`` in the world; 0 where they fail.
        status: ``(*B, N)``.
    """

    observed: Observations
    centers: Tensor
    points: Vector3
    status: Tensor


@torch.no_grad()
def _find(posed: Posed, frame: str) -> tuple[FoundPoints, Vector3, Tensor]:
    """Points, the same in the world, and their status, without gradient."""

    def product(x: Vector4) -> Vector4:
        return product_of(posed, x)

    # What the normal matrix loses of the rows' digits matters to those who have them.
    polish, columns = 0, None
    if posed.dtype == torch.float64 and frame == "world":
        columns = columns_of(
            posed.observed
        )  # extreme weights leave the normal matrix few digits there
    elif posed.dtype == torch.float64:
        polish = 2
    eps = torch.finfo(posed.dtype).eps
    found = find_points(
        posed.normal, posed.frame, eps=eps, product=product, polish=polish, columns=columns
    )
    places = in_world(found.points, posed.around)
    # A projection matrix is K [R | t] with K[2, 2] = 1: its third row gives metric depth.
    depth = in_views(posed.observed.proj[..., 2, :], places)
    unused = posed.observed.weights.unused
    if not surely_all(~unused):
        depth = torch.where(unused, 1.0, depth)
    x, y, z = places
    held = x.abs() + y.abs() + z.abs() <= torch.finfo(posed.dtype).max
    in_front = depth.amin(dim=-2) > 0
    status = judge_points(found, posed.frame, in_front=in_front, representable=held)
    return found, places, status


def _values(posed: Posed, frame: str) -> _Solved:
    _, places, status = _find(posed, frame)
    points = kept_in_world(places, status == Status.OK.value)
    return _Solved(posed.observed, posed.centers, points, status)


def _derivable(posed: Posed, frame: str) -> _Solved:
    found, _, status = _find(posed, frame)
    valid = status == Status.OK.value
    near = derivable_points(posed.normal, posed.frame, found.vector, valid)
    return _Solved(posed.observed, posed.centers, kept(near, posed.around, valid), status)


def _outward(points: Vector3, dtype: torch.dtype) -> Tensor:
    return torch.stack(points, dim=-1).to(dtype)


def _places_in_frame(found: FoundPoints, dtype: torch.dtype) -> Tensor:
    """``(*B, 3, N)`` in units of the frame, to start from; float32 at least."""
    x, y, z, w = found.vector
    inverse = w.reciprocal()
    places = torch.stack([x * inverse, y * inverse, z * inverse], dim=-2)
    return places.to(torch.promote_types(dtype, torch.float32))


def _check_frame(frame: str) -> None:
    if frame not in ("rig", "world"):
        raise ValueError(f"frame must be 'rig' or 'world', got {frame!r}")
