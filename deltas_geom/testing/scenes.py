"""Scenes one can sketch: posed cameras, points, and the pixels that show them.

The named ones are the places where multi-view code breaks. Their entries are exact (0, 1,
small integers), so that a tie between singular values is a tie and not rounding.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor

from deltas_geom.cameras.homogeneous import to_homogeneous
from deltas_geom.cameras.projection import project
from deltas_geom.cameras.views import PosedViews
from deltas_geom.checks import check_shapes

IMAGE_SIZE = (480, 640)
"""(height, width) that :func:`default_intrinsics` belong to."""


class PosedScene(NamedTuple):
    """Cameras, points and where the cameras see the points.

    Attributes:
        views: V cameras.
        points: ``(*B, N, 3)`` in the world, metres.
        pixels: ``(*B, V, N, 2)``.
    """

    views: PosedViews
    points: Tensor
    pixels: Tensor

    def sketch(self) -> str:
        """One line, of a scene without batch dims: the first point and where it is seen."""
        seen = ", ".join(_numbers(view[0]) for view in self.pixels)
        more = self.points.shape[0] - 1
        others = f" and {more} more" if more else ""
        point = _numbers(self.points[0])
        return f"{self.views.num_views} views, point {point} m{others}, seen at {seen} px"


def default_intrinsics(*, dtype: torch.dtype = torch.float64) -> Tensor:
    """A camera ``(3, 3)`` of 640 x 480 pixels and about 65 degrees, in whole numbers.

    Example:
        >>> default_intrinsics(dtype=torch.float32)[0]
        tensor([500.,   0., 320.])
    """
    return torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], dtype=dtype)


def intrinsics_per_view(num_views: int, *, dtype: torch.dtype = torch.float64) -> Tensor:
    """A camera ``(V, 3, 3)`` for each view, in whole numbers; the first is the default one.

    They differ in focal length, aspect and principal point: code that takes the anchor's K for
    all views is wrong by tens of pixels.

    Example:
        >>> intrinsics_per_view(2, dtype=torch.float32)[1]
        tensor([[550.,   0., 304.],
                [  0., 475., 248.],
                [  0.,   0.,   1.]])
    """
    K = default_intrinsics(dtype=dtype).repeat(num_views, 1, 1)
    step = torch.arange(num_views).to(dtype) % 5
    K[:, 0, 0] += 50 * step
    K[:, 1, 1] -= 25 * step
    K[:, 0, 2] -= 16 * step
    K[:, 1, 2] += 8 * step
    return K


def rigid(axis_angle: Tensor, translation: Tensor) -> Tensor:
    """Rigid transforms ``(*B, 4, 4)`` from rotations as axis times angle, and translations.

    Args:
        axis_angle: ``(*B, 3)`` rad.
        translation: ``(*B, 3)`` metres.

    Example:
        >>> rigid(torch.zeros(3), torch.tensor([1.0, 2.0, 3.0]))[:, 3]
        tensor([1., 2., 3., 1.])
    """
    check_shapes(axis_angle=(axis_angle, "3"), translation=(translation, "3"))
    flat = axis_angle.reshape(-1, 3)
    rotation = axis_angle_to_rotation_matrix(flat).reshape(*axis_angle.shape, 3)
    return _pose(rotation, translation)


def scene_from(views: PosedViews, points: Tensor) -> PosedScene:
    """The scene in which ``views`` see ``points``, without noise."""
    return PosedScene(views, points, project(views, points).pixels)


def zero_baseline(*, dtype: torch.dtype = torch.float64) -> PosedScene:
    """Two equal cameras in one place: nothing can be triangulated."""
    return scene_from(_views([_IDENTITY, _IDENTITY], [[0, 0, 0], [0, 0, 0]], dtype), _cloud(dtype))


def pure_rotation(*, dtype: torch.dtype = torch.float64) -> PosedScene:
    """Two cameras with one centre away from the origin, turned by 0.2 rad."""
    center = torch.tensor([1.0, -2.0, -1.0], dtype=dtype)
    turns = torch.tensor([[0.0, 0, 0], [0, 0.2, 0]], dtype=dtype)
    rotation = rigid(turns, torch.zeros_like(turns))[..., :3, :3]
    pose = _pose(rotation, -(rotation @ center))
    return scene_from(_with_default_intrinsics(pose), _cloud(dtype) + center)


def right_angle(*, dtype: torch.dtype = torch.float64) -> PosedScene:
    """Two cameras at 90 degrees, 4 m from the point both look at.

    Two singular values of the DLT matrix are equal there: the gradient of a general SVD is NaN.
    """
    views = _views([_IDENTITY, _QUARTER], [[0, 0, 4], [0, 0, 4]], dtype)
    return scene_from(views, torch.zeros(1, 3, dtype=dtype))


def ring(*, dtype: torch.dtype = torch.float64) -> PosedScene:
    """Four cameras around an object at its distance of 4 m, 90 degrees apart, exactly.

    Singular values of the DLT matrix are equal: the gradient of a general SVD is NaN. The
    mean of the camera centres is the point itself.
    """
    turns = [_IDENTITY, _QUARTER, _HALF, _THREE_QUARTERS]
    views = _views(turns, [[0, 0, 4]] * 4, dtype)
    return scene_from(views, torch.zeros(1, 3, dtype=dtype))


def forward_motion(*, dtype: torch.dtype = torch.float64) -> PosedScene:
    """The second camera stands 0.5 m further ahead: the epipole is inside the image."""
    return scene_from(
        _views([_IDENTITY, _IDENTITY], [[0, 0, 0], [0, 0, -0.5]], dtype), _cloud(dtype)
    )


def on_baseline(*, dtype: torch.dtype = torch.float64) -> PosedScene:
    """A point straight ahead of a forward motion: both pixels are epipoles, no parallax."""
    views = _views([_IDENTITY, _IDENTITY], [[0, 0, 0], [0, 0, -0.5]], dtype)
    return scene_from(views, torch.tensor([[0.0, 0, 4]], dtype=dtype))


def behind_camera(*, dtype: torch.dtype = torch.float64) -> PosedScene:
    """A point 4 m behind two cameras side by side, with the pixels that its rays define."""
    views = _views([_IDENTITY, _IDENTITY], [[0, 0, 0], [-0.5, 0, 0]], dtype)
    points = torch.tensor([[0.25, 0.5, -4]], dtype=dtype)
    # Projection through the centre: what the equations say and no camera sees.
    homogeneous = to_homogeneous(points) @ views.proj.mT
    return PosedScene(views, points, homogeneous[..., :2] / homogeneous[..., 2:])


def at_infinity(*, dtype: torch.dtype = torch.float64) -> PosedScene:
    """Parallel rays of two cameras side by side: a star. Its point has no coordinates (inf)."""
    views = _views([_IDENTITY, _IDENTITY], [[0, 0, 0], [-0.5, 0, 0]], dtype)
    pixels = torch.tensor([[[400.0, 200.0]], [[400.0, 200.0]]], dtype=dtype)
    return PosedScene(views, torch.full((1, 3), torch.inf, dtype=dtype), pixels)


DEGENERATE_SCENES: dict[str, Callable[..., PosedScene]] = {
    "zero_baseline": zero_baseline,
    "pure_rotation": pure_rotation,
    "right_angle": right_angle,
    "ring": ring,
    "forward_motion": forward_motion,
    "on_baseline": on_baseline,
    "behind_camera": behind_camera,
    "at_infinity": at_infinity,
}
"""Every named scene; each takes ``dtype=``."""

_IDENTITY = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
_QUARTER = [[0, 0, -1], [0, 1, 0], [1, 0, 0]]
_HALF = [[-1, 0, 0], [0, 1, 0], [0, 0, -1]]
_THREE_QUARTERS = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]


def _pose(rotation: Tensor, translation: Tensor) -> Tensor:
    upper = torch.cat([rotation, translation[..., None]], dim=-1)
    last = torch.zeros_like(upper[..., :1, :])
    last[..., 3] = 1.0
    return torch.cat([upper, last], dim=-2)


def _with_default_intrinsics(pose: Tensor) -> PosedViews:
    K = default_intrinsics(dtype=pose.dtype).expand(*pose.shape[:-2], 3, 3)
    return PosedViews(K, pose)


def _views(
    rotations: list[list[list[int]]], translations: list[list[float]], dtype: torch.dtype
) -> PosedViews:
    rotation = torch.tensor(rotations, dtype=dtype)
    return _with_default_intrinsics(_pose(rotation, torch.tensor(translations, dtype=dtype)))


def _cloud(dtype: torch.dtype) -> Tensor:
    points = [[0.5, 0.25, 4.0], [-1.0, 0.5, 3.0], [0.75, -0.5, 5.0]]
    return torch.tensor(points, dtype=dtype)


def _numbers(vector: Tensor) -> str:
    return "(" + ", ".join(f"{value:.7g}" for value in vector.tolist()) + ")"
