"""Epipolar segments: depth range ∩ in front of the source ∩ source image.

A point of the anchor's ray at inverse depth w projects to a + w b in homogeneous source
pixels. Being in front and inside the image are then linear in w, so the visible part is one
interval, found exactly by clipping: no segment is dropped because an end leaves the image.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import safe_divide, with_one
from deltas_geom.cameras.poses import inverse_of_finite
from deltas_geom.cameras.projection import rays_of_finite
from deltas_geom.cameras.views import PosedViews, finite_views
from deltas_geom.checks import batch_shape, check_depth_range, check_image_size, check_shapes
from deltas_geom.epipolar.fundamental import inverse_intrinsics
from deltas_geom.numerics.arithmetic import (
    both,
    finite_or_zero,
    only,
    outside_gradients,
    promoted,
    without_autocast,
    without_gradients,
)
from deltas_geom.records import Record
from deltas_geom.status import Status

# A point counts as in front of the source if it lies before its plane by more than this power of
# eps times its distance from the anchor plus the baseline. On the plane a pixel is a quotient of
# roundings; before it they are at most eps^-1/3 times those of a point far from it.
_CLEARANCE = 1 / 3
_ROUNDINGS = 4  # of eps times the terms of an epipolar ray; drawn rigs show less than 1


class EpipolarRays(NamedTuple):
    """Anchor rays seen by the sources: inverse depth w projects to ``origin + w * slope``.

    Attributes:
        origin: ``(*B, V-1, N, 3)`` homogeneous source pixel of the point at infinity.
        slope: ``(*B, V-1, 1, 3)`` K t, the homogeneous epipole, pixels times metres.
        usable: ``(*B, V-1, N)`` bool: the keypoint is finite and not so far out that it
            overflows; if not, (0, 0) stands in for it; and both cameras are finite. None if all.
        finite: ``(*B, V-1, N)`` bool: keypoint and cameras are. None if all.
        clearance: ``(*B, 1, N)``, and with inverse depth it grows by ``clearance_slope``: the
            homogeneous depth from which a point counts as in front. Without gradient.
        clearance_slope: ``(*B, V-1, 1)`` metres.
        terms: ``(*B, V-1, N, 3)`` sums of the absolute terms of ``origin``, to whose rounding
            its own is proportional. Without gradient.
        slope_terms: ``(*B, V-1, 1, 3)`` the same of ``slope``.
    """

    origin: Tensor
    slope: Tensor
    usable: Tensor | None
    finite: Tensor | None
    clearance: Tensor
    clearance_slope: Tensor
    terms: Tensor
    slope_terms: Tensor

    def at(self, inv_depth: Tensor) -> Tensor:
        """Homogeneous source pixels ``(*B, V-1, N, S, 3)`` at ``(*B, V-1, N, S)`` 1/m."""
        return self.origin[..., None, :] + inv_depth[..., None] * self.slope[..., None, :]


class Segments(Record):
    """The visible part of every keypoint's epipolar line in every source.

    Attributes:
        start: ``(*B, V-1, N, 2)`` pixel of the far end.
        end: ``(*B, V-1, N, 2)`` pixel of the near end.
        inv_depth_start: ``(*B, V-1, N)`` inverse of the anchor's z at the far end, 1/m.
        inv_depth_end: ``(*B, V-1, N)`` the same at the near end.
        status: ``(*B, V-1, N)`` int8 of :class:`Status`: OK; NO_PARALLAX where the segment is a
            point (``end`` is then ``start``, whatever the inverse depths); EMPTY where nothing of
            the range is visible and NOT_FINITE_INPUT where the keypoint or a camera is not finite
            (ends and inverse depths are then 0, with zero gradient).
        foreshortening: ``(*B, V-1, N)`` homogeneous depth at the near end over that at the
            far end; it tells how inverse depth runs between the two ends.
    """

    start: Tensor
    end: Tensor
    inv_depth_start: Tensor
    inv_depth_end: Tensor
    status: Tensor
    foreshortening: Tensor

    @property
    def visible(self) -> Tensor:
        """``(*B, V-1, N)`` bool: there is something to sample."""
        return (self.status == Status.OK.value) | (self.status == Status.NO_PARALLAX.value)


def epipolar_rays(views: PosedViews, pixels: Tensor) -> EpipolarRays:
    """How the anchor's pixels ``(*B, N, 2)`` move through the sources with inverse depth.

    Raises as :func:`epipolar_segments`.
    """
    cameras, posed, batch = finite_views(views)
    check_shapes(K=(cameras[0], "+V 3 3"), pixels=(pixels, "N 2"))
    batch_shape(batch, pixels.shape[:-2])
    K, cam_from_world, pixels = promoted(*cameras, pixels)
    anchor_from_world = cam_from_world[..., :1, :, :]
    source_from_anchor = cam_from_world[..., 1:, :, :] @ inverse_of_finite(anchor_from_world)
    K_source = K[..., 1:, :, :]
    known, near = finite_or_zero(pixels, limit=torch.finfo(pixels.dtype).max ** 0.75)
    usable = finite = None
    if near is not None:
        usable, finite = near[..., 0].unsqueeze(-2), pixels.isfinite().all(dim=-1).unsqueeze(-2)
    if posed is not None:
        sources = (posed[..., 1:, :, :] & posed[..., :1, :, :])[..., 0]
        usable, finite = both(usable, sources), both(finite, sources)
    rays = rays_of_finite(K[..., 0, :, :], known).unsqueeze(-3)
    translation = source_from_anchor[..., :3, 3:]
    origin = rays @ (K_source @ source_from_anchor[..., :3, :3]).mT
    slope = (K_source @ translation).mT
    with outside_gradients():
        share = torch.finfo(origin.dtype).eps ** _CLEARANCE
        clearance = share * rays.abs().amax(dim=-1)
        clearance_slope = share * translation.abs().amax(dim=-2)
        poses = cam_from_world.abs()
        to_source = K_source.abs() @ poses[..., 1:, :3, :3]
        from_anchor = poses[..., :1, :3, :3].mT
        homography = to_source @ from_anchor @ inverse_intrinsics(K[..., :1, :, :]).abs()
        terms = with_one(known.abs()).unsqueeze(-3) @ homography.mT
        slope_terms = to_source @ from_anchor @ poses[..., :1, :3, 3:]
        slope_terms = slope_terms + K_source.abs() @ poses[..., 1:, :3, 3:]
    return EpipolarRays(
        origin, slope, usable, finite, clearance, clearance_slope, terms, slope_terms.mT
    )


@without_autocast
def epipolar_segments(
    views: PosedViews,
    pixels: Tensor,
    *,
    depth_range: tuple[float, float],
    image_size: tuple[int, int],
) -> Segments:
    """Segments of the sources on which the anchor's keypoints can be matched.

    Args:
        views: the anchor (view 0) and its V-1 sources.
        pixels: ``(*B, N, 2)`` keypoints of the anchor.
        depth_range: (near, far) along the anchor's z axis, metres; far may be ``inf``.
        image_size: (height, width) of the sources.

    Returns:
        Segments that are exactly the visible part: every depth of the range that is visible
        lies on them, none outside. In front of the source is what lies before its plane by more
        than eps^1/3 of the distance from the anchor plus the baseline (6e-6 in float64, 5e-3 in
        float32): nearer, pixels are quotients of roundings. A keypoint within rounding of the
        epipole has a point and NO_PARALLAX, however far the range runs past the source; in
        float32 that rounding is smaller if the world's origin is near the cameras.

    Raises:
        ShapeError: a trailing shape differs, batch dims do not broadcast, or there is no view.
        ValueError: the depth range or the image size makes no sense.

    Source: the paper, section 3.2 and figure 3; clipping as in Liang and Barsky (1984).

    Example:
        >>> K = torch.tensor([[100.0, 0, 50], [0, 100, 40], [0, 0, 1]]).expand(2, 3, 3)
        >>> pose = torch.eye(4).repeat(2, 1, 1)
        >>> pose[1, 0, 3] = -0.2
        >>> segments = epipolar_segments(
        ...     PosedViews(K, pose), torch.tensor([[60.0, 40.0]]),
        ...     depth_range=(0.5, 10.0), image_size=(80, 100))
        >>> segments.start[0, 0], segments.end[0, 0]
        (tensor([58., 40.]), tensor([20., 40.]))
    """
    check_depth_range(depth_range)
    check_image_size(image_size)
    rays = epipolar_rays(views, pixels)
    near, far = depth_range
    height, width = image_size
    origin, slope = rays.origin, rays.slope.expand_as(rays.origin)

    def margins(homogeneous: Tensor, clearance: Tensor) -> Tensor:
        """``(..., 5)`` from what a pixel must not leave: in front, left, right, top, bottom."""
        x, y, z = homogeneous.unbind(dim=-1)
        # Not by a matrix, whose numbers would be copied to the device and waited for.
        left, right = x + 0.5 * z, (width - 0.5) * z - x
        top, bottom = y + 0.5 * z, (height - 0.5) * z - y
        # In front by more than rounding, so that the division by depth below is safe.
        return torch.stack([z - clearance, left, right, top, bottom], dim=-1)

    # Each asks constant + w growth >= 0 of the inverse depth w.
    constant, growth = margins(origin, rays.clearance), margins(slope, rays.clearance_slope)
    moving = growth != 0
    crossing = safe_divide(-constant, growth, moving)
    low = torch.where(moving & (growth > 0), crossing, -torch.inf).amax(dim=-1)
    high = torch.where(moving & (growth < 0), crossing, torch.inf).amin(dim=-1)
    low, high = low.clamp(min=1 / far), high.clamp(max=1 / near)
    always_out = (~moving & (constant < 0)).any(dim=-1)
    visible = only((low <= high) & ~always_out, rays.usable, other=False)

    low, high = torch.where(visible, low, 0.0), torch.where(visible, high, 0.0)
    ends = rays.at(torch.stack([low, high], dim=-1))
    end_pixels = safe_divide(ends[..., :2], ends[..., 2:], visible[..., None, None])
    start, end = end_pixels.unbind(dim=-2)
    still = _stands_still(rays)
    # Where the pixel stands still, the end that lies farther before the source says best where.
    farther = (ends[..., 0, 2] >= ends[..., 1, 2])[..., None]
    point = torch.where(farther, start, end)
    start, end = (torch.where(still[..., None], point, x) for x in (start, end))
    length = (end - start).abs().amax(dim=-1)
    a_point = still | (length <= 16 * torch.finfo(length.dtype).eps * max(height, width))
    status = torch.where(a_point, Status.NO_PARALLAX.value, Status.OK.value)
    status = torch.where(visible, status, Status.EMPTY.value)
    status = only(status, rays.finite, other=Status.NOT_FINITE_INPUT.value).to(torch.int8)
    foreshortening = torch.where(
        visible, safe_divide(ends[..., 1, 2], ends[..., 0, 2], visible), 1.0
    )
    return Segments(start, end, low, high, status, foreshortening)


@without_gradients
def _stands_still(rays: EpipolarRays) -> Tensor:
    """Whether pixels move with inverse depth by rounding alone, ``(*B, V-1, N)`` bool."""
    o, s, a, b = rays.origin, rays.slope, rays.terms, rays.slope_terms
    # A pixel's derivative by inverse depth is this, divided by its squared homogeneous depth.
    moved = s[..., :2] * o[..., 2:] - o[..., :2] * s[..., 2:]
    noise = b[..., :2] * a[..., 2:] + a[..., :2] * b[..., 2:]
    eps = torch.finfo(moved.dtype).eps
    still: Tensor = (moved.abs() <= _ROUNDINGS * eps * noise).all(dim=-1)
    return still
