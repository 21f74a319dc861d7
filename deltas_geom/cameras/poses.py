"""Rigid transforms ``b_from_a`` as 4x4 matrices: inverse, relative pose, validity.

What comes of a pose that is not finite is NaN, so that whatever uses it next can tell, and passes
no gradient.
"""

import torch
from torch import Tensor

from deltas_geom.checks import check_batch, check_shapes
from deltas_geom.numerics.arithmetic import finite_or_zero, only, promoted, without_autocast


@without_autocast
def invert_pose(b_from_a: Tensor) -> Tensor:
    """``a_from_b`` of rigid transforms ``(*B, 4, 4)``: transpose, no matrix inverse.

    Example:
        >>> b_from_a = torch.eye(4)
        >>> b_from_a[0, 3] = 2.0
        >>> invert_pose(b_from_a)[0, 3]
        tensor(-2.)
    """
    check_shapes(b_from_a=(b_from_a, "4 4"))
    known, finite = finite_or_zero(b_from_a, dims=2)
    return only(inverse_of_finite(known), finite, other=torch.nan)


def inverse_of_finite(b_from_a: Tensor) -> Tensor:
    """:func:`invert_pose` of what is finite."""
    rows, last = b_from_a.split_with_sizes([3, 1], dim=-2)
    rotation, translation = rows.split_with_sizes([3, 1], dim=-1)
    center = -rotation.mT @ translation
    return torch.cat([torch.cat([rotation.mT, center], dim=-1), last], dim=-2)


@without_autocast
def relative_pose(b_from_world: Tensor, a_from_world: Tensor) -> Tensor:
    """``b_from_a`` ``(*B, 4, 4)`` of two cameras posed in one world; ``*B`` broadcasts."""
    check_batch(b_from_world=(b_from_world, "4 4"), a_from_world=(a_from_world, "4 4"))
    b_from_world, a_from_world = promoted(b_from_world, a_from_world)
    (b, b_finite), (a, a_finite) = finite_or_zero(b_from_world, 2), finite_or_zero(a_from_world, 2)
    return only(b @ inverse_of_finite(a), a_finite, b_finite, other=torch.nan)


@without_autocast
def camera_centers(cam_from_world: Tensor) -> Tensor:
    """World positions ``(*B, 3)`` of cameras ``(*B, 4, 4)``, metres."""
    check_shapes(cam_from_world=(cam_from_world, "4 4"))
    known, finite = finite_or_zero(cam_from_world, dims=2)
    rotation, translation = known[..., :3, :].split_with_sizes([3, 1], dim=-1)
    centers = -(rotation * translation).sum(dim=-2, keepdim=True)
    return only(centers, finite, other=torch.nan).squeeze(-2)


@without_autocast
def recentred(cam_from_world: Tensor, view: int | None) -> tuple[Tensor, Tensor]:
    """Poses ``(*B, V, 4, 4)`` in a world moved to the centre of a view or of all: and by how much.

    Returns:
        The poses, and ``(*B, 3)``, which added to points gives those of the old world.
    """
    known, finite = finite_or_zero(cam_from_world, dims=2)
    rotation, translation = known[..., :3, :].split_with_sizes([3, 1], dim=-1)
    centers = -(rotation * translation).sum(dim=-2)
    sound = torch.ones_like(centers[..., :1]) if finite is None else finite[..., 0].to(known)
    if view is None:
        offset = centers.sum(dim=-2) / sound.sum(dim=-2).clamp(min=1)
    else:
        offset = centers.select(-2, view)
    # The difference of centres first: the translation itself may be rounded at its size.
    moved = rotation @ (offset.unsqueeze(-2) - centers).unsqueeze(-1)
    rows = torch.cat([rotation, moved], dim=-1)
    poses = torch.cat([rows, known[..., 3:, :]], dim=-2)
    return only(poses, finite, other=torch.nan), offset


def is_rigid(b_from_a: Tensor, *, tolerance: float = 1e-3) -> Tensor:
    """Whether ``(*B, 4, 4)`` are finite rotations with a translation, ``(*B)`` bool.

    A value check: it synchronises the device when its result is used in Python.

    Args:
        b_from_a: ``(*B, 4, 4)``.
        tolerance: largest deviation of an entry of R R^T from the identity. Poses written
            with six digits are within 1e-5; a scaled or sheared matrix is not within 1e-3.
            Rounding to half precision is tolerated, too.

    Raises:
        ShapeError: the trailing shape differs.
        ValueError: the tolerance is negative.
    """
    check_shapes(b_from_a=(b_from_a, "4 4"))
    if not tolerance >= 0:
        raise ValueError(f"tolerance must not be negative, got {tolerance}")
    return _is_rigid(b_from_a, max(tolerance, 2 * torch.finfo(b_from_a.dtype).eps))


@without_autocast
def _is_rigid(b_from_a: Tensor, tolerance: float) -> Tensor:
    rotation = b_from_a[..., :3, :3]
    identity = torch.eye(4, device=b_from_a.device, dtype=b_from_a.dtype)
    orthogonal = ((rotation @ rotation.mT - identity[:3, :3]).abs() <= tolerance).all(-1).all(-1)
    proper = torch.linalg.det(rotation.nan_to_num()) > 0
    last_row = ((b_from_a[..., 3, :] - identity[3]).abs() <= tolerance).all(dim=-1)
    finite = b_from_a.isfinite().all(-1).all(-1)
    rigid: Tensor = finite & orthogonal & proper & last_row
    return rigid
