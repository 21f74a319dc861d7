"""The equations that one list of observations puts to points, each in its own frame."""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.numerics.ldl import Symmetric4, Vector4
from deltas_geom.triangulation.observed import Vector3, cameras_of, clean_pixels
from deltas_geom.triangulation.rig_frame import RigFrame, camera_moments, rig_frame
from deltas_geom.triangulation.solution import in_world
from deltas_geom.triangulation.weights import Weights, weigh_listed


class Listed(NamedTuple):
    """Observations in the solver's type, with everything unusable replaced.

    Attributes:
        camera: ``(3, 4, T)`` projection matrix.
        x: ``(T)`` px, 0 where not finite.
        y: ``(T)``.
        weights: of the pixels.
        point: ``(T)`` index.
    """

    camera: Tensor
    x: Tensor
    y: Tensor
    weights: Weights
    point: Tensor


class PosedTracks(NamedTuple):
    """The points' equations, in their frames: :class:`Linear`.

    Attributes:
        listed: the observations.
        rows: x p3 - p1 and y p3 - p2 in the frame, each four ``(T)``.
        center: ``(3, T)`` of the cameras.
        datum: ``(1, 3)`` the origin of the sums, in the world.
        frame: of the points.
        normal: ten ``(N)``, in the frame.
        dtype: of the inputs.
    """

    listed: Listed
    rows: tuple[Tensor, Tensor]
    center: Tensor
    datum: Tensor
    frame: RigFrame
    normal: Symmetric4
    dtype: torch.dtype

    def product(self, x: Vector4) -> Vector4:
        """As of :class:`Linear`."""
        a, b = self.rows
        place = at(torch.stack(x), self.listed.point)
        along_a, along_b = (a * place).sum(dim=0), (b * place).sum(dim=0)
        rows = self.listed.weights.squared * (a * along_a + b * along_b)
        g0, g1, g2, g3 = summed(rows, self.listed.point, len(x[0]))
        return g0, g1, g2, g3

    def in_front(self, points: Vector3) -> Tensor:
        """As of :class:`Linear`."""
        listed, place = self.listed, torch.stack(in_world(points, self.datum))
        _, _, depth = project_listed(listed.camera, at(place, listed.point))
        behind = torch.where(depth > 0, 0.0, listed.weights.used)
        return summed(behind, listed.point, place.shape[-1]) == 0


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
    camera, broken, centers = cameras_of(proj)
    listed = _listed(camera, pixels, camera_index, point_index, num_points, weights)

    # Of all cameras alike: those that see nothing do no harm beyond rounding.
    datum = centers.detach().mean(dim=0, keepdim=True)
    sums = (
        summed(at(moments, camera_index) * times, point_index, num_points).unbind()
        for moments, times in zip(
            camera_moments(centers, datum, broken),
            (listed.weights.squared, listed.weights.used),
            strict=True,
        )
    )
    frame = rig_frame(*sums, eps=torch.finfo(proj.dtype).eps)
    frame = frame._replace(finite=frame.finite & listed.weights.sound)
    held = frame.held()
    origin = at(torch.stack(held.origin), point_index) + datum.mT
    unit = at(held.unit, point_index)
    moved = ((listed.camera[:, :3] * origin).sum(dim=1) + listed.camera[:, 3]) / unit
    p1, p2, p3 = torch.cat([listed.camera[:, :3], moved[:, None]], dim=1)  # each (4, T)
    rows = listed.x * p3 - p1, listed.y * p3 - p2
    m00, m01, m02, m03, m11, m12, m13, m22, m23, m33 = summed_squares(
        *rows, listed.weights.squared, point_index, num_points
    )
    normal = m00, m01, m02, m03, m11, m12, m13, m22, m23, m33
    center = at(centers.mT, camera_index)
    return PosedTracks(listed, rows, center, datum, frame, normal, proj.dtype)


def _listed(
    camera: Tensor,
    pixels: Tensor,
    camera_index: Tensor,
    point_index: Tensor,
    num_points: int,
    weights: Tensor,
) -> Listed:
    x, y, sound = clean_pixels(pixels)
    sound = torch.ones_like(x, dtype=torch.bool) if sound is None else sound
    return Listed(
        camera=at(camera.permute(1, 2, 0), camera_index),
        x=x,
        y=y,
        weights=weigh_listed(weights.to(x.dtype), point_index, num_points, sound=sound),
        point=point_index,
    )


def summed_squares(
    a: Tensor, b: Tensor, squared: Tensor, point: Tensor, count: int
) -> tuple[Tensor, ...]:
    """Sums of w^2 (a a^T + b b^T) of vectors ``(K, T)``, upper triangle: K (K + 1) / 2 ``(N)``."""
    wa, wb, size = squared * a, squared * b, len(a)
    entries = [
        torch.addcmul(wa[i] * a[j], wb[i], b[j]) for i in range(size) for j in range(i, size)
    ]
    return summed(torch.stack(entries), point, count).unbind(dim=0)


def summed(values: Tensor, index: Tensor, count: int) -> Tensor:
    """Sums ``(*K, N)`` over observations ``(*K, T)`` of each point."""
    return values.new_zeros(*values.shape[:-1], count).index_add(-1, index, values)


def at(values: Tensor, index: Tensor) -> Tensor:
    """``(*K, T)``: of each observation, the value ``(*K, N)`` of its point or camera."""
    return values.index_select(-1, index)


def project_listed(camera: Tensor, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Homogeneous pixels of points ``(3, T)`` in cameras ``(3, 4, T)``, each ``(T)``."""
    x, y, depth = (camera[:, :3] * points).sum(dim=1) + camera[:, 3]
    return x, y, depth
