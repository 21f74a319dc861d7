"""The equations of pixels, each point's in its own frame."""

from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from deltas_geom.checks import check_positive
from deltas_geom.numerics.arithmetic import only, unless_all
from deltas_geom.numerics.sums import over_views, plain, product
from deltas_geom.numerics.vectors import Symmetric4, Vector3, Vector4, dot, plus
from deltas_geom.triangulation.dlt import normal_coefficients, normal_matrix
from deltas_geom.triangulation.observed import Cameras, Observations, homogeneous_in_views, in_views
from deltas_geom.triangulation.rig_frame import (
    Moments,
    RigFrame,
    camera_moments,
    datum_of,
    in_frame,
    rig_frame,
    rig_sums,
)
from deltas_geom.triangulation.weights import weigh

Frame = Literal["rig", "world"]


def check_settings(frame: Frame, max_residual: float | None = None) -> None:
    """Raise ``ValueError`` where a setting makes no sense."""
    if frame not in ("rig", "world"):
        raise ValueError(f"frame must be 'rig' or 'world', got {frame!r}")
    if max_residual is not None:
        check_positive(max_residual=max_residual)


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
        observed: what is seen of the points.
        dtype: of the inputs.
        fixed: the frame is the world's: it depends on no camera and no weight.
    """

    rig: Rig
    frame: RigFrame
    normal: Symmetric4
    observed: Observations
    dtype: torch.dtype
    fixed: bool

    @property
    def datum(self) -> Tensor:
        """As of :class:`Linear`."""
        return self.rig.datum

    def product(self, x: Vector4) -> Vector4:
        """As of :class:`Linear`."""
        near, (px, py, weights) = self.rig.near, self.observed
        a, b, c = homogeneous_in_views(near, out_of_frame(self.frame, x))
        across, down = (px * c - a) * weights.squared, (py * c - b) * weights.squared
        errors = torch.stack([-across, -down, px * across + py * down], dim=-2).flatten(-3, -2)
        *sums, last = over_views(near.flatten(-3, -2).mT, errors)
        return (*sums, (dot(self.frame.origin, tuple(sums)) + last) / self.frame.unit)

    def in_front(self, points: Vector3) -> Tensor:
        """As of :class:`Linear`."""
        # A projection matrix is K [R | t] with K[2, 2] = 1: its third row gives metric depth.
        row, unused = self.rig.near[..., 2, :], self.observed.weights.unused
        if plain(row, unused, *points):
            return _ahead_at_hand(row, unused, points)
        depth = in_views(row, *points)
        return only(depth, unless_all(~unused), other=1.0).amin(dim=-2) > 0


def _ahead_at_hand(row: Tensor, unused: Tensor, points: Vector3) -> Tensor:
    """Depth above 0 in all used views, in NumPy, which starts no threads."""
    place = np.stack([axis.detach().numpy() for axis in points], axis=-2)
    with np.errstate(all="ignore"):  # what has failed may be anywhere
        depth = product(row[..., :3], torch.from_numpy(place)).numpy()
        ahead = (depth > -row[..., 3:].detach().numpy()) | unused.numpy()
    return torch.from_numpy(ahead.all(axis=-2))


def rig_of(cameras: Cameras) -> Rig:
    """All that is needed of cameras ``(*B, V, 3, 4)``."""
    rows, datum = cameras.proj[..., :3], datum_of(cameras.centers)
    # Of M (x - centre): nothing cancels, wherever the world's origin is.
    moved = cameras.proj[..., 3:] + (rows * datum.unsqueeze(-2)).sum(dim=-1, keepdim=True)
    near = torch.cat([rows, moved], dim=-1)
    moments = camera_moments(cameras.centers, datum, cameras.broken)
    return Rig(cameras, datum, near, normal_coefficients(near), moments)


class Alike(NamedTuple):
    """The one frame of points that all views see and that all weigh the same, and coefficients of
    their normal matrices in it.
    """

    frame: RigFrame
    coefficients: Tensor


def alike_of(rig: Rig, frame: Frame, dtype: torch.dtype) -> Alike:
    """What points without weights and mask share."""
    like = rig.cameras.proj[..., :1]
    weights = weigh(None, None, batch=like.shape[:-3], like=like, sound=None)
    framed = _framed(rig, rig_sums(rig.moments, weights), frame, dtype)
    # Few cameras are moved, not every matrix.
    moved = cameras_in_frame(rig.near, framed.held())
    return Alike(framed, normal_coefficients(moved, weights.squared))


def equations_of(
    rig: Rig,
    observed: Observations,
    *,
    frame: Frame,
    dtype: torch.dtype,
    alike: Alike | None = None,
) -> Equations:
    """The equations of what cameras see; ``dtype`` of the inputs, ``alike`` where points are."""
    x, y, weights = observed
    if alike is None:
        framed = _framed(rig, rig_sums(rig.moments, weights), frame, dtype)
        held, normal = framed.held(), normal_matrix(rig.coefficients, x, y, weights.squared)
        normal = in_frame(normal, held.origin, held.unit)
    else:
        framed, normal = alike.frame, normal_matrix(alike.coefficients, x, y)
    framed = framed._replace(finite=framed.finite & weights.sound)
    return Equations(rig, framed, normal, observed, dtype, frame == "world")


def _framed(
    rig: Rig, sums: tuple[tuple[Tensor, ...], tuple[Tensor, ...]], frame: Frame, dtype: torch.dtype
) -> RigFrame:
    found = rig_frame(*sums, eps=torch.finfo(dtype).eps)
    if frame == "rig":
        return found
    origin = tuple(-place.expand_as(found.unit) for place in rig.datum.unbind(dim=-1))
    return found._replace(origin=origin, unit=torch.ones_like(found.unit))


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
