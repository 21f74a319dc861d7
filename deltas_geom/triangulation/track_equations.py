"""The equations that one list of observations puts to points, each in its own frame."""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.numerics.arithmetic import solver_dtype
from deltas_geom.numerics.ldl import Symmetric4
from deltas_geom.triangulation.observed import projection_centers
from deltas_geom.triangulation.rig_frame import RigFrame, camera_moments, rig_frame
from deltas_geom.triangulation.weights import NEGLIGIBLE_WEIGHT


class Listed(NamedTuple):
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


class PosedTracks(NamedTuple):
    """The points' equations, in their frames.

    Attributes:
        listed: the observations.
        rows: x p3 - p1 and y p3 - p2 in the frame, each four ``(T)``.
        datum: ``(1, 3)`` the origin of the sums, in the world.
        frame: of the points.
        normal: ten ``(N)``, in the frame.
        dtype: of the inputs.
    """

    listed: Listed
    rows: tuple[Tensor, Tensor]
    datum: Tensor
    frame: RigFrame
    normal: Symmetric4
    dtype: torch.dtype


def pose_tracks(
    proj: Tensor,
    pixels: Tensor,
    camera_index: Tensor,
    point_index: Tensor,
    weights: Tensor,
    *,
    num_points: int,
) -> PosedTracks:
    """The equations of what :func:`triangulate_tracks` is given, its arguments checked.

    Args:
        proj: ``(C, 3, 4)``.
        pixels: ``(T, 2)``.
        camera_index: ``(T)`` int64.
        point_index: ``(T)`` int64.
        weights: ``(T)``.
        num_points: N.
    """
    work = solver_dtype(proj)
    finite = (proj.detach().to(work).abs() < torch.finfo(work).max ** 0.25).all(-1).all(-1)
    camera = torch.where(finite[:, None, None], proj, 0.0).to(work)
    listed = _listed(camera, pixels, camera_index, point_index, num_points, weights)

    centers = projection_centers(camera)
    # Of all cameras alike: those that see nothing do no harm beyond rounding.
    datum = centers.detach().mean(dim=0, keepdim=True)
    weighted, counted = camera_moments(centers, datum, (~finite).to(work))
    frame = rig_frame(
        summed(at(weighted, camera_index) * listed.squared, point_index, num_points).unbind(),
        summed(
            torch.where(listed.unused, 0.0, at(counted, camera_index)), point_index, num_points
        ).unbind(),
        eps=torch.finfo(proj.dtype).eps,
    )
    frame = frame._replace(finite=frame.finite & listed.sound)
    origin = at(torch.stack(frame.origin), point_index) + datum.mT
    unit = at(frame.unit, point_index)
    moved = ((listed.camera[:, :3] * origin).sum(dim=1) + listed.camera[:, 3]) / unit
    p1, p2, p3 = torch.cat([listed.camera[:, :3], moved[:, None]], dim=1)  # each (4, T)
    rows = listed.x * p3 - p1, listed.y * p3 - p2
    normal = _normal_matrix(rows, listed.squared, point_index, num_points)
    return PosedTracks(listed, rows, datum, frame, normal, proj.dtype)


def _listed(
    camera: Tensor,
    pixels: Tensor,
    camera_index: Tensor,
    point_index: Tensor,
    num_points: int,
    weights: Tensor,
) -> Listed:
    x, y = pixels.to(camera.dtype).unbind(dim=-1)
    weight = weights.to(camera.dtype)
    with torch.no_grad():
        size = weight.abs()
        # What is beyond overflows; NaN is not below.
        sound = (x * x + y * y < torch.finfo(x.dtype).max ** 0.25) & (
            size <= torch.finfo(x.dtype).max
        )
        # NaN counts as used.
        largest = at(_largest(size.nan_to_num(0.0), point_index, num_points), point_index)
        unused = size <= NEGLIGIBLE_WEIGHT * largest
        wrong = summed((~(sound | unused)).to(x.dtype), point_index, num_points)
        largest = torch.where((largest > 0) & largest.isfinite(), largest, 1.0)
    # Double where: what is not used must pass no gradient and no NaN.
    share = torch.where(sound, weight, 0.0) / largest
    return Listed(
        camera=at(camera.permute(1, 2, 0), camera_index),
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
    m00, m01, m02, m03, m11, m12, m13, m22, m23, m33 = summed(entries, point, count).unbind(dim=0)
    return m00, m01, m02, m03, m11, m12, m13, m22, m23, m33


def summed(values: Tensor, index: Tensor, count: int) -> Tensor:
    """Sums ``(*K, N)`` over observations ``(*K, T)`` of each point."""
    return values.new_zeros(*values.shape[:-1], count).index_add(-1, index, values)


def _largest(values: Tensor, index: Tensor, count: int) -> Tensor:
    """Largest of non-negative ``(T)`` over each point's observations, ``(N)``; 0 if none."""
    return values.new_zeros(count).scatter_reduce(0, index, values, "amax")


def at(values: Tensor, index: Tensor) -> Tensor:
    """``(*K, T)``: of each observation, the value ``(*K, N)`` of its point or camera."""
    return values.index_select(-1, index)


def project_listed(camera: Tensor, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Homogeneous pixels of points ``(3, T)`` in cameras ``(3, 4, T)``, each ``(T)``."""
    x, y, depth = (camera[:, :3] * points).sum(dim=1) + camera[:, 3]
    return x, y, depth
