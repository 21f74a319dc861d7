"""Weighted, masked n-view DLT triangulation; every point carries a Status.

Each point is solved in its own rig frame (rig_frame.py), in float64 whatever the input, where the
device has it. Backward keeps only the inputs and computes the rest again.
"""

from typing import Literal, NamedTuple

import torch
from torch import Tensor

from deltas_geom.chunks import in_chunks
from deltas_geom.ldl import Symmetric4, Vector4
from deltas_geom.normal_matrix import normal_matrix
from deltas_geom.observations import (
    Observations,
    Vector3,
    observe,
    over_views,
    projection_centers,
)
from deltas_geom.rig_frame import (
    FoundPoints,
    RigFrame,
    derivable_points,
    find_points,
    in_frame,
    in_world,
    judge_points,
    kept,
    rig_frames,
)
from deltas_geom.status import Status
from deltas_geom.uncertainty import (
    covariance_of,
    in_views,
    parallax_of,
    reproject,
    residual_of,
    unpacked3,
)

# Steps in float64. In the world's frame extreme weights leave the normal matrix few digits.
_POLISH = {"rig": 2, "world": 16}


class Triangulation(NamedTuple):
    """Triangulated points and what is known about them.

    Attributes:
        points: ``(*B, N, 3)`` in the world, metres; (0, 0, 0) with zero gradient if not valid.
        depth: ``(*B, V, N)`` along each camera's z axis, metres; 0 if not valid.
        status: ``(*B, N)`` int8 of :class:`Status`.
        valid: ``(*B, N)`` bool, status is OK.
        residual: ``(*B, N)`` weighted RMS distance of the projections from the pixels, px.
        parallax: ``(*B, N)`` largest angle between rays of used views, rad.
        covariance: ``(*B, N, 3, 3)`` for pixel noise of standard deviation 1 / weight px, m^2;
            None unless asked for.
    """

    points: Tensor
    depth: Tensor
    status: Tensor
    valid: Tensor
    residual: Tensor
    parallax: Tensor
    covariance: Tensor | None


def triangulate_points(
    proj: Tensor,
    pixels: Tensor,
    weights: Tensor | None = None,
    mask: Tensor | None = None,
    *,
    frame: Literal["rig", "world"] = "rig",
) -> Tensor:
    """Points ``(*B, N, 3)`` alone; see :func:`triangulate`."""
    _check_frame(frame)

    def values(*inputs: Tensor) -> tuple[Tensor]:
        return (_outward(_values(*inputs, frame=frame), proj.dtype),)

    def derivable(*inputs: Tensor) -> tuple[Tensor]:
        return (_outward(_derivable(*inputs, frame=frame), proj.dtype),)

    points = ((pixels, -2), (weights, -1), (mask, -1))
    return in_chunks(derivable, values, proj, points, dims=(-2,))[0]


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
        Points with status. Nothing raises or turns NaN because of values.

    Raises:
        ShapeError: a trailing shape differs.

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

    def known(solved: _Solved) -> tuple[Tensor, ...]:
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
        if covariance:
            noise = unpacked3(covariance_of(observed.proj, seen, observed.weights.squared))
            unit = observed.weights.largest.squeeze(-2)[..., None, None]
            # Divided twice: the square of a small weight may be 0.
            found = (*found, noise / unit / unit)
        outward = (tensor.to(proj.dtype).clamp(-limit, limit) for tensor in found)
        return (*outward, solved.status)

    def values(*inputs: Tensor) -> tuple[Tensor, ...]:
        return known(_values(*inputs, frame=frame))

    def derivable(*inputs: Tensor) -> tuple[Tensor, ...]:
        return known(_derivable(*inputs, frame=frame))

    dims = (-2, -1, -1, -1, *([-3] if covariance else []), -1)
    points = ((pixels, -2), (weights, -1), (mask, -1))
    found = in_chunks(derivable, values, proj, points, dims=dims)
    places, depth, residual, parallax, *noise, status = found
    valid = status == Status.OK.value
    return Triangulation(
        places, depth, status, valid, residual, parallax, noise[0] if noise else None
    )


class _Posed(NamedTuple):
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


def _pose(
    proj: Tensor,
    pixels: Tensor,
    weights: Tensor | None,
    mask: Tensor | None,
    *,
    frame: str,
) -> _Posed:
    observed = observe(proj, pixels, weights, mask)
    centers = projection_centers(observed.proj)
    eps = torch.finfo(proj.dtype).eps
    around, rig = rig_frames(centers, observed.weights, observed.sick, eps=eps)
    moved = observed.proj[..., 3:] + observed.proj[..., :3] @ around.unsqueeze(-3).mT
    near = torch.cat([observed.proj[..., :3].expand(*moved.shape[:-1], 3), moved], dim=-1)
    if frame == "world":
        ox, oy, oz = (-middle.expand_as(rig.unit) for middle in around.unbind(dim=-1))
        rig = rig._replace(origin=(ox, oy, oz), unit=torch.ones_like(rig.unit))
    x, y = observed.xy.unbind(dim=-2)
    squared = observed.weights.squared
    if rig.unit.shape[-1] == 1:  # one frame for all: few cameras are moved, not every matrix
        normal = _ten(normal_matrix(_cameras_in_frame(near, rig), x, y, squared))
    else:
        normal = in_frame(_ten(normal_matrix(near, x, y, squared)), rig.origin, rig.unit)
    return _Posed(observed, around, near, centers, rig, normal, proj.dtype)


def _ten(entries: tuple[Tensor, ...]) -> Symmetric4:
    m00, m01, m02, m03, m11, m12, m13, m22, m23, m33 = entries
    return m00, m01, m02, m03, m11, m12, m13, m22, m23, m33


def _cameras_in_frame(proj: Tensor, frame: RigFrame) -> Tensor:
    """P T of cameras ``(*B, V, 3, 4)``, where :func:`in_frame` takes M to T^T M T."""
    rows = proj[..., :3]
    origin = torch.stack(frame.origin, dim=-2).unsqueeze(-3)  # (*B, 1, 3, 1)
    last = (rows @ origin + proj[..., 3:]) / frame.unit[..., None, None]
    return torch.cat([rows.expand(*last.shape[:-1], 3), last], dim=-1)


@torch.no_grad()
def _find(posed: _Posed, frame: str) -> tuple[FoundPoints, Tensor]:
    """Points and their status, without gradient."""

    def product(x: Vector4) -> Vector4:
        return _product(posed, x)

    # What the normal matrix loses of the rows' digits matters to those who have them.
    polish = 0
    if posed.dtype == torch.float64:
        polish = _POLISH[frame]
    eps = torch.finfo(posed.dtype).eps
    found = find_points(posed.normal, posed.frame, eps=eps, product=product, polish=polish)
    x, y, z = in_world(found.points, posed.around)
    # A projection matrix is K [R | t] with K[2, 2] = 1: its third row gives metric depth.
    depth = in_views(posed.observed.proj[..., 2, :], (x, y, z))
    in_front = torch.where(posed.observed.weights.unused, 1.0, depth).amin(dim=-2) > 0
    held = x.abs() + y.abs() + z.abs() <= torch.finfo(posed.dtype).max
    status = judge_points(found, posed.frame, in_front=in_front, representable=held)
    return found, status


def _values(*inputs: Tensor, frame: str) -> _Solved:
    posed = _pose(*inputs, frame=frame)
    found, status = _find(posed, frame)
    points = kept(found.points, posed.around, status == Status.OK.value)
    return _Solved(posed.observed, posed.centers, points, status)


def _derivable(*inputs: Tensor, frame: str) -> _Solved:
    posed = _pose(*inputs, frame=frame)
    found, status = _find(posed, frame)
    valid = status == Status.OK.value
    near = derivable_points(posed.normal, posed.frame, found.vector, valid)
    return _Solved(posed.observed, posed.centers, kept(near, posed.around, valid), status)


def _product(posed: _Posed, v: Vector4) -> Vector4:
    """A^T W^2 (A v) of the equations in the frame: the normal matrix times v, unsquared."""
    (ox, oy, oz), inverse = posed.frame.origin, 1 / posed.frame.unit
    w = v[3] * inverse
    place = (torch.addcmul(v[0], ox, w), torch.addcmul(v[1], oy, w), torch.addcmul(v[2], oz, w))
    p, squared = posed.proj, posed.observed.weights.squared
    x, y = posed.observed.xy.unbind(dim=-2)
    a, b, c = (_homogeneous_in_views(p[..., row, :], (*place, w)) for row in range(3))
    across, down = (x * c - a) * squared, (y * c - b) * squared
    sums = torch.stack([-across, -down, x * across + y * down], dim=-2).flatten(-3, -2)
    g0, g1, g2, g3 = over_views(p.flatten(-3, -2).mT, sums)
    return g0, g1, g2, (ox * g0 + oy * g1 + oz * g2 + g3) * inverse


def _homogeneous_in_views(row: Tensor, points: Vector4) -> Tensor:
    total = row[..., 3, None] * points[3].unsqueeze(-2)
    for axis in range(3):
        total = torch.addcmul(total, row[..., axis, None], points[axis].unsqueeze(-2))
    return total


def _outward(solved: _Solved, dtype: torch.dtype) -> Tensor:
    return torch.stack(solved.points, dim=-1).to(dtype)


def _check_frame(frame: str) -> None:
    if frame not in ("rig", "world"):
        raise ValueError(f"frame must be 'rig' or 'world', got {frame!r}")
