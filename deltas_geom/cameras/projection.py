"""World points to pixels and back."""

import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import safe_divide, with_one
from deltas_geom.cameras.views import PosedViews, finite_intrinsics, finite_views
from deltas_geom.checks import batch_shape, check_batch, check_shapes
from deltas_geom.numerics.arithmetic import finite_or_zero, only, promoted, without_autocast
from deltas_geom.records import Record


class Projection(Record):
    """Where world points appear.

    Attributes:
        pixels: ``(*B, V, N, 2)``; (0, 0) with zero gradient where the point is not in front.
        depth: ``(*B, V, N)`` along each camera's z axis, metres; 0 where the point or the camera
            is not finite or the point too far to represent.
        in_front: ``(*B, V, N)`` bool: depth > 0, and the pixel and its gradient can be
            represented (a point closer to the camera's plane than that has no pixel).
    """

    pixels: Tensor
    depth: Tensor
    in_front: Tensor


@without_autocast
def project(views: PosedViews, points: Tensor) -> Projection:
    """Project world points into every view.

    Args:
        views: V cameras.
        points: ``(*B, N, 3)`` in the world, metres. ``*B`` broadcasts with the views'.

    Raises:
        ShapeError: a trailing shape differs, or batch dims do not broadcast.

    Source: Hartley and Zisserman, 2nd ed., section 6.1.

    Example:
        >>> K = torch.tensor([[[100.0, 0, 50], [0, 100, 40], [0, 0, 1]]])
        >>> views = PosedViews(K, torch.eye(4)[None])
        >>> project(views, torch.tensor([[0.0, 0.1, 2.0]])).pixels
        tensor([[[50., 45.]]])
    """
    check_shapes(points=(points, "N 3"))
    cameras, posed, batch = finite_views(views)
    batch_shape(batch, points.shape[:-2])
    K, cam_from_world, points = promoted(*cameras, points)
    known, finite = finite_or_zero(points.unsqueeze(-3))
    homogeneous = with_one(known) @ (K @ cam_from_world[..., :3, :]).mT
    homogeneous, _ = finite_or_zero(only(homogeneous, finite, posed))
    depth = homogeneous[..., 2]
    # Pixels and 1 / depth enter the gradient squared, times the size of the point.
    small = torch.finfo(depth.dtype).tiny ** (1 / 3)
    size = torch.maximum(homogeneous.detach().abs().amax(dim=-1), known.detach().abs().amax(dim=-1))
    in_front = (depth > small) & (depth > small * size)
    pixels = safe_divide(homogeneous[..., :2], depth[..., None], in_front[..., None])
    return Projection(pixels, depth, in_front)


@without_autocast
def unproject(views: PosedViews, pixels: Tensor, depth: Tensor) -> Tensor:
    """World points seen at pixels of each view, at a depth along its z axis.

    Args:
        views: V cameras.
        pixels: ``(*B, V, N, 2)``. ``(*B, N, V, 2)`` goes unnoticed where N = V: then the points
            that views see of one scene do not meet.
        depth: ``(*B, V, N)`` metres.

    Returns:
        ``(*B, V, N, 3)`` world points, metres; (0, 0, 0) with zero gradient where the pixel, the
        depth (as sensors mark it unknown) or the camera is not finite. A depth of 0, as others
        mark it, is the camera's centre.

    Raises:
        ShapeError: a trailing shape differs, or batch dims do not broadcast.
    """
    cameras, posed, batch = finite_views(views)
    check_shapes(K=(cameras[0], "V 3 3"), pixels=(pixels, "V N 2"), depth=(depth, "V N"))
    batch_shape(batch, pixels.shape[:-3], depth.shape[:-2])
    K, cam_from_world, pixels, depth = promoted(*cameras, pixels, depth)
    (pixels, seen), (depth, measured) = finite_or_zero(pixels), finite_or_zero(depth[..., None])
    rotation, translation = cam_from_world[..., :3, :].split_with_sizes([3, 1], dim=-1)
    points = (rays_of_finite(K, pixels) * depth - translation.mT) @ rotation
    return only(points, seen, measured, posed)


@without_autocast
def pixel_rays(K: Tensor, pixels: Tensor) -> Tensor:
    """Rays through pixels in the camera's own frame, scaled to depth 1.

    Args:
        K: ``(*B, 3, 3)`` upper triangular.
        pixels: ``(*B, N, 2)``.

    Returns:
        ``(*B, N, 3)``; the last coordinate is 1. Where the pixel or the camera is not finite there
        is no ray: (0, 0, 0), which passes no gradient and is no direction for whatever takes rays.

    Raises:
        ShapeError: a trailing shape differs, or batch dims do not broadcast.
    """
    check_batch(K=(K, "3 3"), pixels=(pixels, "N 2"))
    K, pixels = promoted(K, pixels)
    (K, known), (pixels, seen) = finite_intrinsics(K), finite_or_zero(pixels)
    return only(rays_of_finite(K, pixels), seen, known)


def entries_of(K: Tensor) -> tuple[Tensor, ...]:
    """fx, skew, cx, fy and cy, each ``(*B, 1)``, of intrinsics ``(*B, 3, 3)``."""
    of_x, of_y, _ = K.unsqueeze(-1).unbind(dim=-3)
    return (*of_x.unbind(dim=-2), *of_y.unbind(dim=-2)[1:])


def rays_of_finite(K: Tensor, pixels: Tensor) -> Tensor:
    """:func:`pixel_rays` of what is finite, with focal lengths that are not 0."""
    # Back substitution: exact for a camera and cheaper than a general inverse.
    fx, skew, cx, fy, cy = entries_of(K)
    x, y = pixels.unbind(dim=-1)
    y = (y - cy) / fy
    x = (x - cx - skew * y) / fx
    return torch.stack([x, y, torch.ones_like(x)], dim=-1)
