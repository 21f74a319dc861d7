"""Optimal triangulation of two views: the least reprojection error, in closed form.

Two steps of Lindstrom's correction move the pair of pixels, as little as possible, onto
corresponding epipolar lines. Then the rays cross, exactly, and the point is there.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import safe_divide, safe_sqrt
from deltas_geom.checks import check_batch
from deltas_geom.epipolar.fundamental import cross_matrix
from deltas_geom.numerics.arithmetic import only, outside_gradients, without_autocast
from deltas_geom.numerics.sums import product
from deltas_geom.numerics.vectors import Vector3, dot
from deltas_geom.records import Record
from deltas_geom.status import Status
from deltas_geom.triangulation.judge import judge
from deltas_geom.triangulation.observed import Cameras, cameras_of, clean_pixels
from deltas_geom.triangulation.operation import operation
from deltas_geom.triangulation.reprojection import reproject
from deltas_geom.triangulation.results import beyond, within_residual, without
from deltas_geom.triangulation.uncertainty import covariance_of, unpacked3


class TwoViewTriangulation(Record):
    """Points of two views, and the pixels at which the two see them.

    Attributes:
        points: ``(*B, N, 3)`` in the world, metres; (0, 0, 0) with zero gradient if not valid.
        pixels: ``(*B, 2, N, 2)`` corrected: the projections of the points. Those given, without
            gradient, if not valid (0 where unused or not finite; corrected where the point was
            refused by its residual or depth).
        depth: ``(*B, 2, N)`` along each camera's z axis, metres; 0 if not valid.
        status: ``(*B, N)`` int8 of :class:`Status`.
        valid: ``(*B, N)`` bool, status is OK.
        residual: ``(*B, N)`` RMS distance of corrected from given pixels, px; 0 if not valid.
        parallax: ``(*B, N)`` angle between the two rays at the point, rad; without gradient.
        errors: ``(*B, 2, N)`` distance of corrected from given pixels, px; 0 if not valid.
        covariance: ``(*B, N, 3, 3)`` for pixel noise of standard deviation 1 px, m^2; None unless
            asked for; 0 if not valid.
    """

    points: Tensor
    pixels: Tensor
    depth: Tensor
    status: Tensor
    valid: Tensor
    residual: Tensor
    parallax: Tensor
    errors: Tensor
    covariance: Tensor | None

    within_residual = within_residual

    def within_depth(
        self, depth_range: tuple[float, float], *, view: int | None = None
    ) -> "TwoViewTriangulation":
        """As :meth:`Triangulation.within_depth`, the range being that of both views, or of one."""
        outside = beyond(self.depth, depth_range)
        outside = outside.any(dim=-2) if view is None else outside[..., view, :]
        return without(self, outside, Status.OUT_OF_RANGE)


@without_autocast
def triangulate_two_view(
    proj: Tensor,
    pixels: Tensor,
    mask: Tensor | None = None,
    *,
    covariance: bool = False,
    max_residual: float | None = None,
) -> TwoViewTriangulation:
    """Triangulate matched pixels of two views with the least squared reprojection error.

    Args:
        proj: ``(*B, 2, 3, 4)`` K [R | t].
        pixels: ``(*B, 2, N, 2)`` matches; those of unused views may hold anything.
        mask: ``(*B, 2, N)`` bool, True = used. Both views of a point have to be.
        covariance: also compute the covariance of the points.
        max_residual: px; points about which the views disagree by more are RESIDUAL_TOO_LARGE.
            Pixels handed over as (N, 2, 2) where N = 2 have residuals of many pixels, too.

    Returns:
        Points, corrected pixels, status. Nothing raises or turns NaN because of values. At 1 px
        of noise the squared error exceeds its minimum by a share of 1e-9 typically, by 1e-5 for
        one point in 1000; pixels within their noise of an epipole may have another minimum.

    Raises:
        ShapeError, TypeError: a trailing shape differs, the mask is not bool.
        ValueError: ``max_residual`` is not positive.

    Source: Lindstrom, Triangulation Made Easy (CVPR 2010), algorithm niter2.

    Example:
        >>> left = torch.tensor([[100.0, 0, 50, 0], [0, 100, 40, 0], [0, 0, 1, 0]])
        >>> right = left - 20 * (torch.arange(12) == 3).reshape(3, 4)  # 20 cm to the right
        >>> pixels = torch.tensor([[[60.0, 42.0]], [[50.0, 38.0]]])  # rows 4 px apart
        >>> result = triangulate_two_view(torch.stack([left, right]), pixels)
        >>> result.pixels.flatten().round(decimals=3)
        tensor([60., 40., 50., 40.])
        >>> result.points.round(decimals=3), result.residual
        (tensor([[0.2000, 0.0000, 2.0000]]), tensor([2.]))
    """
    check_batch(proj=(proj, "2 3 4"), pixels=(pixels, "2 N 2"), mask=(mask, "2 N"))
    return operation(
        TwoViewTriangulation,
        (proj, pixels, mask),
        see=_see,
        solve=_judged,
        follow=lambda seen, _, valid: _solve(seen, valid),
        describe=_describe,
        dtype=torch.promote_types(proj.dtype, pixels.dtype),
        covariance=covariance,
        max_residual=max_residual,
    )


class _Seen(NamedTuple):
    """The inputs in the solver's type, broadcast, with everything unusable replaced.

    Attributes:
        cameras: those that are not finite replaced by 0.
        fundamental: ``(*B, 3, 3)`` with x1^T F x2 = 0 and largest entry 1; 0 if there is none.
        xy: ``(*B, 2, 2, N)`` px, 0 where unused or not finite.
        finite: ``(*B, N)`` bool: everything used is.
        enough: ``(*B, N)`` bool: both views are used.
        dtype: of the inputs.
    """

    cameras: Cameras
    fundamental: Tensor
    xy: Tensor
    finite: Tensor
    enough: Tensor
    dtype: torch.dtype


def _see(proj: Tensor, pixels: Tensor, mask: Tensor | None) -> _Seen:
    x, y, sound = clean_pixels(pixels)
    used = torch.ones_like(x, dtype=torch.bool) if mask is None else mask
    cameras = cameras_of(proj)
    finite = only((cameras.broken == 0).unsqueeze(-1), sound, other=False)
    xy = torch.where((finite & used).unsqueeze(-2), torch.stack([x, y], dim=-2), 0.0)
    known, enough = (finite | ~used).all(dim=-2), used.all(dim=-2)
    dtype = torch.promote_types(proj.dtype, pixels.dtype)
    return _Seen(cameras, _fundamental(cameras), xy, known, enough, dtype)


def _fundamental(cameras: Cameras) -> Tensor:
    """Source: Hartley and Zisserman, 2nd ed., section 9.2.2."""
    first, second = cameras.inverse.unbind(dim=-3)
    baseline = cross_matrix(cameras.centers.diff(dim=-2).squeeze(-2))
    fundamental = first.mT @ baseline @ second
    largest = fundamental.detach().abs().amax(dim=(-2, -1), keepdim=True)
    return safe_divide(fundamental, largest, (largest > 0) & largest.isfinite())


class _Solved(NamedTuple):
    """Points before they are judged; anything where they fail.

    Attributes:
        points: ``(*B, 3, N)`` in the world.
        shift: ``(*B, 2, 2, N)`` px, given less corrected pixels.
        depth: ``(*B, 2, N)``.
        parallax: ``(*B, N)`` rad, without gradient.
        sine: ``(*B, N)`` of that.
        beside: ``(*B, 2, N)`` metres by which the other's ray passes each camera; likewise.
    """

    points: Tensor
    shift: Tensor
    depth: Tensor
    parallax: Tensor
    sine: Tensor
    beside: Tensor


def _solve(seen: _Seen, valid: Tensor | None = None) -> _Solved:
    """Points of pixels. What is not ``valid``, if given, passes no gradient and no NaN."""
    inverse, centers = seen.cameras.inverse, seen.cameras.centers
    xy = seen.xy if valid is None else torch.where(valid[..., None, None, :], seen.xy, 0.0)
    shift = _correction(seen.fundamental, xy)
    ray = product(inverse[..., :2], xy - shift) + inverse[..., 2:]
    size = _safe(ray.detach().abs().amax(dim=-2))
    ray = ray / size.unsqueeze(-2)
    # By components, which costs half of torch.linalg.cross and its gradient.
    first, second = (one.unbind(dim=-2) for one in ray.unbind(dim=-3))
    baseline = centers.diff(dim=-2).mT.unbind(dim=-2)
    across = _cross(first, second)
    passing = _cross(baseline, second), _cross(baseline, first)
    squared = dot(across, across)
    along = torch.stack([dot(one, across) for one in passing], dim=-2)
    along = along / _safe(squared).unsqueeze(-2)
    # From both cameras, so that their order does not count.
    points = (centers[..., None] + ray * along.unsqueeze(-2)).mean(dim=-3)
    with outside_gradients():
        beside = torch.stack([safe_sqrt(dot(one, one)) for one in passing], dim=-2)
        length, cosine = safe_sqrt(squared), dot(first, second)
        sine = length * _safe(squared + cosine * cosine).rsqrt()
        parallax = torch.atan2(length, cosine)
    return _Solved(points, shift, along / size, parallax, sine, beside)


def _correction(fundamental: Tensor, xy: Tensor) -> Tensor:
    """What to take from pixels ``(*B, 2, 2, N)`` so that the rays of each pair meet, px."""
    x1, x2 = xy.unbind(dim=-3)
    # Normals of the epipolar lines, and the epipolar error.
    a1, b1, last = (product(fundamental[..., :2], x2) + fundamental[..., 2:]).unbind(dim=-2)
    back = fundamental[..., :2].mT
    a2, b2 = (product(back[..., :2], x1) + back[..., 2:]).unbind(dim=-2)
    error = a1 * x1[..., 0, :] + b1 * x1[..., 1, :] + last
    # In units of the longer normal all that follows is in pixels, near the epipoles too.
    share = 1 / _safe(torch.stack([a1, b1, a2, b2]).detach().abs().amax(dim=0))
    a1, b1, a2, b2, error = (value * share for value in (a1, b1, a2, b2, error))
    f00, f01, f10, f11 = (fundamental[..., i, j, None] * share for i in (0, 1) for j in (0, 1))

    # The pair that moves by k times its normals meets where error - 2 half k + curve k^2 = 0.
    da1, db1 = f00 * a2 + f01 * b2, f10 * a2 + f11 * b2
    da2, db2 = f00 * a1 + f10 * b1, f01 * a1 + f11 * b1
    curve = a1 * da1 + b1 * db1
    squared1, squared2 = a1 * a1 + b1 * b1, a2 * a2 + b2 * b2
    half = (squared1 + squared2) / 2
    under = half * half - curve * error
    real = under > 0
    root = safe_sqrt(torch.where(real, under, 1.0))
    # Gross errors near the epipoles have no such pair: there one pixel moves to the other's line.
    k = error / _safe(torch.where(real, half + root, torch.maximum(squared1, squared2)))
    k1 = torch.where(real | (squared1 >= squared2), k, 0.0)
    k2 = torch.where(real | (squared1 < squared2), k, 0.0)

    # The lines through that pair correspond: the given pixels' nearest on them meet exactly.
    def moved(k: Tensor, a: Tensor, b: Tensor, new_a: Tensor, new_b: Tensor) -> Tensor:
        share = k * (a * new_a + b * new_b) / _safe(new_a * new_a + new_b * new_b)
        return torch.stack([share * new_a, share * new_b], dim=-2)

    first = moved(k1, a1, b1, a1 - k2 * da1, b1 - k2 * db1)
    second = moved(k2, a2, b2, a2 - k1 * da2, b2 - k1 * db2)
    return torch.stack([first, second], dim=-3)


def _safe(divisor: Tensor) -> Tensor:
    """1 in place of what is not positive, nor its square."""
    return torch.where(divisor > torch.finfo(divisor.dtype).tiny ** 0.4, divisor, 1.0)


def _judged(seen: _Seen) -> tuple[_Solved, Tensor]:
    """Points, and their status ``(*B, N)`` int8."""
    centers, eps, solved = seen.cameras.centers, torch.finfo(seen.dtype).eps, _solve(seen)
    exist = (seen.cameras.inverse != 0).any(dim=-1).any(dim=-1).all(dim=-1, keepdim=True)
    length = centers.diff(dim=-2).norm(dim=-1) * exist
    size = centers.norm(dim=-1).amax(dim=-1)[..., None]
    # Centres closer together than the rounding of where they are do not differ. On the baseline
    # both rays pass the other camera within rounding: as given, since there a correction may be
    # the root of a rounding.
    given = product(seen.cameras.inverse[..., :2], seen.xy) + seen.cameras.inverse[..., 2:]
    given = given / _safe(given.abs().amax(dim=-2)).unsqueeze(-2)
    across = _cross(centers.diff(dim=-2)[..., None].unbind(dim=-2), given.unbind(dim=-2))
    aside = dot(across, across).amax(dim=-2)
    posed = (length > 128 * eps * size) & (aside > (8 * eps * (size + length)).square())
    farther = solved.beside.amax(dim=-2)
    # The law of sines: the baseline and a distance, without the point, which may be anywhere.
    near = solved.sine * length > 32 * eps * farther
    near = near & solved.points.to(seen.dtype).isfinite().all(dim=-2)
    # At a camera's centre the depth is 0 within rounding.
    apart = solved.beside > 64 * torch.finfo(length.dtype).eps * length.unsqueeze(-2)
    in_front = (apart & (solved.depth > 0)).all(dim=-2)
    status = judge(
        finite=seen.finite, enough=seen.enough, posed=posed, near=near, in_front=in_front
    )
    return solved, status


def _describe(seen: _Seen, solved: _Solved, valid: Tensor, covariance: bool) -> dict[str, Tensor]:
    both = valid.unsqueeze(-2)
    squared = torch.where(both.unsqueeze(-2), solved.shift, 0.0).square().sum(dim=-2)
    points = torch.where(both, solved.points, 0.0)
    found = {
        "points": points.mT,
        "pixels": torch.where(both.unsqueeze(-2), seen.xy - solved.shift, seen.xy.detach()).mT,
        "depth": torch.where(both, solved.depth, 0.0),
        "residual": safe_sqrt(squared.mean(dim=-2)),
        "parallax": torch.where(valid, solved.parallax, 0.0),
        "errors": safe_sqrt(squared),
    }
    if covariance:
        again = reproject(seen.cameras.proj, points.unbind(dim=-2), both.expand_as(squared))
        noise = covariance_of(seen.cameras.proj, again, torch.ones_like(squared))
        found["covariance"] = unpacked3(noise)
    return found


def _cross(a: Vector3, b: Vector3) -> Vector3:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
