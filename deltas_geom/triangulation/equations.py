"""The equations of pixels, each point's in its own frame."""

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from deltas_geom.numerics.arithmetic import surely_all
from deltas_geom.numerics.chunks import joined
from deltas_geom.numerics.sums import over_views
from deltas_geom.numerics.vectors import Symmetric4, Vector3, Vector4, dot, plus
from deltas_geom.triangulation.dlt import normal_coefficients, normal_matrix
from deltas_geom.triangulation.observed import (
    Cameras,
    Observations,
    cameras_of,
    homogeneous_in_views,
)
from deltas_geom.triangulation.reprojection import in_views
from deltas_geom.triangulation.rig_frame import (
    Moments,
    RigFrame,
    camera_moments,
    datum_of,
    in_frame,
    rig_frame,
    rig_sums,
)
from deltas_geom.triangulation.short import ShortRig
from deltas_geom.triangulation.weights import weigh

Frame = Literal["rig", "world"]


class Rig(NamedTuple):
    """What depends on the cameras alone.

    Attributes:
        cameras: in the solver's type.
        datum: ``(*B, 1, 3)`` a place in the world near the cameras, from which points are counted.
        near: ``(*B, V, 3, 4)`` the cameras of points so counted.
        coefficients: of these points' normal matrices.
        moments: of the cameras, for the points' frames.
    """

    cameras: Cameras
    datum: Tensor
    near: Tensor
    coefficients: Tensor
    moments: Moments


class Equations(NamedTuple):
    """What N points have to satisfy: :class:`Linear`.

    Attributes:
        rig: the cameras.
        frame: in which each point is solved.
        normal: ten ``(*B, N)``, in that frame.
        parts: what is seen of the points, some at a time.
        dtype: of the inputs.
        fixed: the frame is the world's: it depends on no camera and no weight.
    """

    rig: Rig
    frame: RigFrame
    normal: Symmetric4
    parts: Sequence[Observations]
    dtype: torch.dtype
    fixed: bool

    @property
    def datum(self) -> Tensor:
        """As of :class:`Linear`."""
        return self.rig.datum

    def product(self, x: Vector4) -> Vector4:
        """As of :class:`Linear`."""
        near, origin = self.rig.near, self.frame.origin

        def summed(part: Observations, *place: Tensor) -> tuple[Tensor, ...]:
            x, y, weights = part
            a, b, c = homogeneous_in_views(near, place)
            across, down = (x * c - a) * weights.squared, (y * c - b) * weights.squared
            sums = torch.stack([-across, -down, x * across + y * down], dim=-2).flatten(-3, -2)
            return over_views(near.flatten(-3, -2).mT, sums)

        *sums, last = self.each(summed, *out_of_frame(self.frame, x))
        return (*sums, (dot(origin, tuple(sums)) + last) / self.frame.unit)

    def in_front(self, points: Vector3) -> Tensor:
        """As of :class:`Linear`."""
        # A projection matrix is K [R | t] with K[2, 2] = 1: its third row gives metric depth.
        row = self.rig.near[..., 2, :]

        def nearest(part: Observations, *points: Tensor) -> tuple[Tensor]:
            depth, unused = in_views(row, points), part.weights.unused
            if not surely_all(~unused):
                depth = torch.where(unused, 1.0, depth)
            return (depth.amin(dim=-2),)

        return self.each(nearest, *points)[0] > 0

    def each(
        self,
        function: Callable[..., tuple[Tensor, ...]],
        *points: Tensor,
        dims: Sequence[int] | None = None,
    ) -> tuple[Tensor, ...]:
        """``function(part, *points)`` of points ``(..., N)``, part by part, its results joined.

        Along the last dim, or the ``dims`` given.
        """
        if len(self.parts) == 1:
            return function(self.parts[0], *points)
        found, start = [], 0
        for part in self.parts:
            count = part.x.shape[-1]
            found.append(function(part, *(tensor.narrow(-1, start, count) for tensor in points)))
            start += count
        columns = list(zip(*found, strict=True))
        return tuple(map(joined, columns, dims or [-1] * len(columns)))


def rig_of(proj: Tensor) -> Rig:
    """All that is needed of cameras ``(*B, V, 3, 4)``."""
    return _rig(cameras_of(proj))


def rig_like(known: ShortRig) -> Rig:
    """The same from what the short way needs, which is found faster."""
    proj, finite, centers = map(torch.from_numpy, (known.proj, known.finite, known.centers))
    return _rig(Cameras(proj, (~finite).double(), centers))


def _rig(cameras: Cameras) -> Rig:
    rows, datum = cameras.proj[..., :3], datum_of(cameras.centers)
    # Of M (x - centre): nothing cancels, wherever the world's origin is.
    moved = cameras.proj[..., 3:] + (rows * datum.unsqueeze(-2)).sum(dim=-1, keepdim=True)
    near = torch.cat([rows, moved], dim=-1)
    moments = camera_moments(cameras.centers, datum, cameras.broken)
    return Rig(cameras, datum, near, normal_coefficients(near), moments)


class Alike(NamedTuple):
    """The one frame of points that all views see and that all weigh the same.

    Attributes:
        frame: of one point.
        coefficients: of the points' normal matrices in that frame.
    """

    frame: RigFrame
    coefficients: Tensor


def alike_of(rig: Rig, frame: Frame, dtype: torch.dtype) -> Alike:
    """What points without weights and mask share."""
    like = rig.cameras.proj[..., :1]
    weights = weigh(None, None, batch=like.shape[:-3], like=like, sound=None)
    framed = _framed(rig, rig_sums(rig.moments, weights), frame, dtype)
    # Few cameras are moved, not every matrix.
    return Alike(framed, normal_coefficients(cameras_in_frame(rig.near, framed.held())))


def equations_of(
    rig: Rig,
    parts: Sequence[Observations],
    *,
    frame: Frame,
    dtype: torch.dtype,
    alike: Alike | None = None,
) -> Equations:
    """The equations of what cameras see.

    Args:
        rig: of the cameras.
        parts: pixels and weights, of some points each.
        frame: "rig" or "world".
        dtype: of the inputs.
        alike: of points without weights and mask.
    """
    (sound,) = _of_all([(part.weights.sound,) for part in parts], parts)
    if alike is None:
        sums = zip(*(rig_sums(rig.moments, part.weights) for part in parts), strict=True)
        weighted, counted = (_of_all(list(rows), parts) for rows in sums)
        framed = _framed(rig, (weighted, counted), frame, dtype)
    else:
        framed = alike.frame
    coefficients = rig.coefficients if alike is None else alike.coefficients
    made = [normal_matrix(coefficients, x, y, weights.squared) for x, y, weights in parts]
    normal = _of_all(made, parts)
    if alike is None:
        held = framed.held()
        normal = in_frame(normal, held.origin, held.unit)
    framed = framed._replace(finite=framed.finite & sound)
    return Equations(rig, framed, normal, parts, dtype, frame == "world")


def _framed(
    rig: Rig, sums: tuple[tuple[Tensor, ...], tuple[Tensor, ...]], frame: Frame, dtype: torch.dtype
) -> RigFrame:
    found = rig_frame(*sums, eps=torch.finfo(dtype).eps)
    if frame == "rig":
        return found
    origin = tuple(-place.expand_as(found.unit) for place in rig.datum.unbind(dim=-1))
    return found._replace(origin=origin, unit=torch.ones_like(found.unit))


def _of_all(
    rows: Sequence[tuple[Tensor, ...]], parts: Sequence[Observations]
) -> tuple[Tensor, ...]:
    """Rows of all points from those of each part; one column where all points are alike."""
    if len(rows) == 1 or all(some[0].shape[-1] == 1 for some in rows):
        return rows[0]
    counts = [part.x.shape[-1] for part in parts]
    return tuple(
        joined([row.expand(*row.shape[:-1], n) for row, n in zip(some, counts, strict=True)], -1)
        for some in zip(*rows, strict=True)
    )


def cameras_in_frame(proj: Tensor, frame: RigFrame) -> Tensor:
    """P T of cameras ``(*B, V, 3, 4)``, where :func:`in_frame` takes M to T^T M T."""
    rows = proj[..., :3]
    origin = torch.stack(frame.origin, dim=-1).unsqueeze(-3)  # (*B, 1, 1, 3)
    last = ((rows * origin).sum(dim=-1, keepdim=True) + proj[..., 3:]) / frame.unit[..., None, None]
    return torch.cat([rows.expand(*last.shape[:-1], 3), last], dim=-1)


def out_of_frame(frame: RigFrame, v: Vector4) -> Vector4:
    """T v, where :func:`in_frame` takes M to T^T M T."""
    w = v[3] / frame.unit
    return (*plus(v[:3], w, frame.origin), w)
