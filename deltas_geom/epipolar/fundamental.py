"""Fundamental matrices, epipolar lines and distances to them."""

import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import with_one
from deltas_geom.cameras.poses import inverse_of_finite
from deltas_geom.cameras.views import PosedViews, finite_views
from deltas_geom.checks import check_batch
from deltas_geom.numerics.arithmetic import (
    at_least_in_single,
    finite_or_zero,
    only,
    outside_gradients,
    promoted,
    unless_all,
    without_autocast,
)
from deltas_geom.numerics.vectors import matrix3


def cross_matrix(vectors: Tensor) -> Tensor:
    """[v]x with [v]x u = v x u: ``(*B, 3)`` to ``(*B, 3, 3)``."""
    x, y, z = vectors.unbind(dim=-1)
    zero = torch.zeros_like(x)
    return matrix3(zero, -z, y, z, zero, -x, -y, x, zero)


def inverse_intrinsics(K: Tensor) -> Tensor:
    """Inverse of upper triangular intrinsics ``(*B, 3, 3)``, in closed form."""
    fx, fy, skew = K[..., 0, 0], K[..., 1, 1], K[..., 0, 1]
    cx, cy = K[..., 0, 2], K[..., 1, 2]
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    return matrix3(
        1 / fx, -skew / (fx * fy), (skew * cy - cx * fy) / (fx * fy),
        zero, 1 / fy, -cy / fy,
        zero, zero, one,
    )  # fmt: skip


@at_least_in_single
def fundamental_between(views: PosedViews, anchor: int = 0, source: int = 1) -> Tensor:
    """Fundamental matrix F with x_source^T F x_anchor = 0 for pixels of one point.

    Args:
        views: the cameras, ``(*B, V)``.
        anchor: index of the view whose pixels F is applied to.
        source: index of the view that gets the lines.

    Returns:
        ``(*B, 3, 3)``, F = K_s^-T [t]x R K_a^-1, not normalised: its scale follows the
        baseline, and at zero baseline, within rounding, it is zero, as with a camera that is not
        finite, then without gradient. At least float32.

    Raises:
        ShapeError: shapes of the cameras do not go together.
        IndexError: there is no such view.

    Source: Hartley and Zisserman, 2nd ed., equation 9.2; the paper, section 3.2.
    """
    cameras, finite, _ = finite_views(views)
    K, cam_from_world = promoted(*cameras)
    anchor_from_world, source_from_world = (cam_from_world[..., v, :, :] for v in (anchor, source))
    source_from_anchor = source_from_world @ inverse_of_finite(anchor_from_world)
    baseline = source_from_anchor[..., :3, 3]
    with outside_gradients():
        # Of one centre the product of two poses leaves roundings, whose lines would look sound.
        ends = anchor_from_world[..., :3, 3].abs() + source_from_world[..., :3, 3].abs()
        noise = 8 * torch.finfo(K.dtype).eps * ends.amax(dim=-1, keepdim=True)
        none = (baseline.abs() <= noise).all(dim=-1, keepdim=True)
        rounding = torch.where(none, baseline.detach(), 0.0)
    essential = cross_matrix(baseline - rounding) @ source_from_anchor[..., :3, :3]
    K_anchor, K_source = K[..., anchor, :, :], K[..., source, :, :]
    fundamental = inverse_intrinsics(K_source).mT @ essential @ inverse_intrinsics(K_anchor)
    if finite is None:
        return fundamental
    return only(fundamental, finite[..., anchor, :, :], finite[..., source, :, :])


@without_autocast
def epipolar_lines(fundamental: Tensor, pixels: Tensor) -> Tensor:
    r"""Lines of the second view on which the first view's pixels must lie.

    A line :math:`(a, b, c)` holds the pixels with :math:`ax + by + c = 0`. Its normal
    :math:`(a, b)` has unit length, so the dot product with a homogeneous pixel is a signed
    distance in pixels.

    Args:
        fundamental: ``(*B, 3, 3)``, second view from first: x2^T F x1 = 0.
        pixels: ``(*B, N, 2)`` in the first view. ``*B`` broadcasts.

    Returns:
        ``(*B, N, 3)`` lines. A pixel that is not finite or within rounding of the epipole has
        none: its line is zero and passes no gradient.

    Raises:
        ShapeError: a trailing shape differs, or batch dims do not broadcast.

    Source: Hartley and Zisserman, 2nd ed., section 9.2.
    """
    check_batch(fundamental=(fundamental, "3 3"), pixels=(pixels, "N 2"))
    fundamental, pixels = promoted(fundamental, pixels)
    (fundamental, known), (pixels, seen) = finite_or_zero(fundamental, 2), finite_or_zero(pixels)
    homogeneous = with_one(pixels)
    lines = homogeneous @ fundamental.mT
    size = lines[..., :2].detach().abs().amax(dim=-1, keepdim=True)
    with outside_gradients():
        scale = homogeneous.abs() @ fundamental[..., :2, :].abs().mT
    noise = 16 * torch.finfo(lines.dtype).eps * scale.amax(dim=-1, keepdim=True)
    has_line = unless_all(only(size > noise, seen, known, other=False))
    # Divided by its size first, as the square of a short normal, to the power -3/2 in the
    # gradient, leaves the range of float32. Double where: no NaN from the unused branch.
    lines = only(lines / only(size, has_line, other=1.0), has_line)
    squared = lines[..., :2].square().sum(dim=-1, keepdim=True)
    return lines * only(squared, has_line, other=1.0).rsqrt()


@without_autocast
def epipolar_distance(fundamental: Tensor, first: Tensor, second: Tensor) -> Tensor:
    """Signed distance of the second view's pixels from the first view's epipolar lines.

    Args:
        fundamental: ``(*B, 3, 3)``, second view from first.
        first: ``(*B, N, 2)`` pixels of the first view.
        second: ``(*B, N, 2)`` pixels of the second view.

    Returns:
        ``(*B, N)`` pixels; 0 with zero gradient where there is no line, or a pixel is not finite.

    Raises:
        ShapeError: a trailing shape differs, or batch dims do not broadcast.
    """
    check_batch(fundamental=(fundamental, "3 3"), first=(first, "N 2"), second=(second, "N 2"))
    second, seen = finite_or_zero(second)
    terms = epipolar_lines(fundamental, first) * with_one(second)
    return only(terms, seen).sum(dim=-1)
