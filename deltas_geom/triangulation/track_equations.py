"""The equations that one list of observations puts to points, each in its own frame."""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.numerics.vectors import Symmetric4, Vector3, Vector4
from deltas_geom.triangulation.observed import cameras_of, clean_pixels
from deltas_geom.triangulation.rig_frame import RigFrame, camera_moments, rig_frame
from deltas_geom.triangulation.solution import in_world
from deltas_geom.triangulation.weights import Weights, weigh_listed


class PosedTracks(NamedTuple):
    """What is seen, all that is unusable replaced, and the points' equations: :class:`Linear`.

    Attributes:
        camera: ``(3, 4, T)`` projection matrix of each observation.
        x, y: ``(T)`` px, 0 where not finite.
        weights: of the pixels.
        point: ``(T)`` index.
        rows: x p3 - p1 and y p3 - p2 in the frame, each four ``(T)``.
        center: ``(3, T)`` of the cameras.
        datum: ``(1, 3)`` the origin of the sums, in the world.
        frame: of the points.
        normal: ten ``(N)``, in the frame.
        dtype: of the inputs.
    """

    camera: Tensor
    x: Tensor
    y: Tensor
    weights: Weights
    point: Tensor
    rows: tuple[Tensor, Tensor]
    center: Tensor
    datum: Tensor
    frame: RigFrame
    normal: Symmetric4
    dtype: torch.dtype

    def product(self, x: Vector4) -> Vector4:
        """As of :class:`Linear`."""
        a, b = self.rows
        place = at(torch.stack(x), self.point)
        along_a, along_b = (a * place).sum(dim=0), (b * place).sum(dim=0)
        rows = self.weights.squared * (a * along_a + b * along_b)
        return summed(rows, self.point, len(x[0])).unbind(dim=0)

    def in_front(self, points: Vector3) -> Tensor:
        """As of :class:`Linear`."""
        place = torch.stack(in_world(points, self.datum))
        _, _, depth = project_listed(self.camera, at(place, self.point))
        behind = torch.where(depth > 0, 0.0, self.weights.used)
        return summed(behind, self.point, place.shape[-1]) == 0


def pose_tracks(
    proj: Tensor,
    pixels: Tensor,
    camera_index: Tensor,
    point_index: Tensor,
    weights: Tensor,
    *,
    num_points: int,
) -> PosedTracks:
    """The equations of what :func:`triangulate_tracks` is given, checked, with indices int64."""
    cameras, broken, _, centers = cameras_of(proj)
    camera = at(cameras.permute(1, 2, 0), camera_index)
    x, y, sound = clean_pixels(pixels)
    sound = torch.ones_like(x, dtype=torch.bool) if sound is None else sound
    weighed = weigh_listed(weights.to(x.dtype), point_index, num_points, sound=sound)

    # Of all cameras alike: those that see nothing do no harm beyond rounding.
    datum = centers.detach().mean(dim=0, keepdim=True)
    sums = (
        summed(at(moments, camera_index) * times, point_index, num_points).unbind()
        for moments, times in zip(
            camera_moments(centers, datum, broken), (weighed.squared, weighed.used), strict=True
        )
    )
    frame = rig_frame(*sums, eps=torch.finfo(proj.dtype).eps)
    frame = frame._replace(finite=frame.finite & weighed.sound)
    held = frame.held()
    origin = at(torch.stack(held.origin), point_index) + datum.mT
    unit = at(held.unit, point_index)
    moved = ((camera[:, :3] * origin).sum(dim=1) + camera[:, 3]) / unit
    p1, p2, p3 = torch.cat([camera[:, :3], moved[:, None]], dim=1)  # each (4, T)
    rows = x * p3 - p1, y * p3 - p2
    normal = summed_squares(*rows, weighed.squared, point_index, num_points)
    center, seen = at(centers.mT, camera_index), (camera, x, y, weighed, point_index)
    return PosedTracks(*seen, rows, center, datum, frame, normal, proj.dtype)


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
