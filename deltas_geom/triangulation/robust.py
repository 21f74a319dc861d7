"""Which views are wrong about a point: candidates from pairs of views, judged by all views.

A point has few views, so all pairs are tried where RANSAC would draw some at random.
"""

from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from deltas_geom.checks import check_counts, check_positive
from deltas_geom.numerics.arithmetic import (
    both,
    only,
    outside_gradients,
    surely_all,
    unless_all,
    without_autocast,
)
from deltas_geom.numerics.chunks import Cut
from deltas_geom.numerics.evaluation import in_chunks
from deltas_geom.numerics.sums import product
from deltas_geom.status import Status
from deltas_geom.triangulation.judge import ok
from deltas_geom.triangulation.observed import check_observed, clean_pixels
from deltas_geom.triangulation.pairs import pairs_of, points_of_pairs
from deltas_geom.triangulation.results import RobustTriangulation, of_inliers
from deltas_geom.triangulation.triangulate import Call, KnownCameras
from deltas_geom.triangulation.weights import weigh

_BUDGET = 2**17  # distances at a time: what lies between stays in the cache
_ROUNDS = 3  # of improving the inliers by their own point; the first settles nearly all


@without_autocast
def triangulate_robust(
    proj: Tensor,
    pixels: Tensor,
    weights: Tensor | None = None,
    mask: Tensor | None = None,
    *,
    threshold: float = 4.0,
    min_inliers: int = 2,
    max_pairs: int = 64,
    covariance: bool = False,
) -> RobustTriangulation:
    r"""Find the views that are wrong about each point, and triangulate the others.

    Candidates are the point of all views and that of each pair of views. The best has the
    smallest cost :math:`\sum_v w_v^2 \min(\|e_v\|^2, t^2)` over the used views, e the distance in
    pixels and t the threshold; a view behind which the point lies pays in full. The views within
    the threshold are triangulated; the result is a last candidate. Inliers are within the
    threshold of the point returned: where the weighted point of the views that agree leaves one
    of them, the point is refused.

    Two views confirm each other little: a wrong match near the epipolar line agrees too, and of
    two that disagree both are rejected. ``min_inliers=3`` asks for a third to confirm. With two
    camps of equal cost nothing tells which is right, and the order of views decides.

    Args:
        proj: ``(*B, V, 3, 4)`` K [R | t].
        pixels: ``(*B, V, N, 2)`` matches; those of unused views may hold anything. Handed over as
            (N, V, 2) where N = V they leave hardly an inlier.
        weights: ``(*B, V, N)``, 0 = unused; a sign has no effect. Large ones are rejected last.
        mask: ``(*B, V, N)`` bool, True = used.
        threshold: px, the distance beyond which a view is an outlier, whatever its weight. Of
            noise with standard deviation 1 px in x and y, 4 px rejects one match in 3000, and
            2 px one in 7.
        min_inliers: fewest views that must agree, 2 or more.
        max_pairs: most pairs tried for a point; 64 suffice for all pairs of 11 views. Of more,
            those half the views apart come first, in a sequence the widest baselines, and each
            view as often. The order of views then counts.
        covariance: also compute the covariance of the points.

    Returns:
        What :func:`triangulate` says of the inliers. Where no candidate has ``min_inliers`` the
        status is that of all finite views if it is a failure, else TOO_FEW_VIEWS: too few that
        agree. Views that are not finite are outliers; NOT_FINITE_INPUT is the status where without
        them fewer than two are left. Gradients are those of ``triangulate`` with the
        inliers as its mask: none to outliers. Nothing raises or turns NaN because of values.

    Raises:
        ShapeError, TypeError: a trailing shape differs, there is no view, the mask is not bool.
        ValueError: a threshold that is not positive, ``min_inliers`` below 2, no pairs.

    Source: Torr and Zisserman, MLESAC (2000), section 3 (the cost, MSAC); Chum, Matas and
    Kittler, Locally Optimized RANSAC (2003); Hartley and Zisserman, 2nd ed., section 4.7.

    Example:
        >>> proj = torch.tensor([[100.0, 0, 50, 0], [0, 100, 40, 0], [0, 0, 1, 0]]).repeat(4, 1, 1)
        >>> proj[:, 0, 3] = torch.tensor([0.0, -20, -40, -60])  # 20 cm to the right, each
        >>> pixels = torch.tensor([[60.0, 45], [50, 45], [90, 10], [30, 45]])[:, None]
        >>> result = triangulate_robust(proj, pixels)
        >>> result.inliers[:, 0].tolist(), result.points.round(decimals=3)
        ([True, True, False, True], tensor([[0.2000, 0.1000, 2.0000]]))
    """
    batch = check_observed(proj=proj, pixels=pixels, weights=weights, mask=mask)
    check_positive(threshold=threshold)
    check_counts(2, min_inliers=min_inliers)
    check_counts(1, max_pairs=max_pairs)

    with outside_gradients():
        known = KnownCameras(proj)
        observed = _observe(known, pixels, weights, mask, batch)
        chunk = max(1, min(8192, _BUDGET // max(1, observed.usable.shape[:-1].numel())))
        cut = Cut(chunk, (0, -2, -1, -1, -1, -1, 0, -1), (-1, -1))
        agree = partial(_consensus, known, threshold, min_inliers, max_pairs)
        inliers, reason = in_chunks(agree, cut, *observed)
    found = Call(known, pixels, weights, inliers, "rig").full(covariance=covariance)
    return of_inliers(found, inliers, reason)


class _Observations(NamedTuple):
    """The inputs in the solver's type, broadcast, with everything unusable replaced.

    Attributes:
        proj: ``(*B, V, 3, 4)`` finite.
        pixels: ``(*B, V, N, 2)`` finite.
        weights: ``(*B, V, N)`` as given, or None.
        squared: ``(*B, V, N)`` their squares, the largest of usable ones 1; 0 where not usable.
        usable: ``(*B, V, N)`` used, finite, of a weight that counts.
        finite: ``(*B, N)`` everything used is finite.
        centers: ``(*B, V, 3)`` of the cameras.
        directions: ``(*B, 3, V, N)`` of rays of depth 1, in the world; 0 if there is no centre.
    """

    proj: Tensor
    pixels: Tensor
    weights: Tensor | None
    squared: Tensor
    usable: Tensor
    finite: Tensor
    centers: Tensor
    directions: Tensor


def _observe(
    known: KnownCameras,
    pixels: Tensor,
    weights: Tensor | None,
    mask: Tensor | None,
    batch: torch.Size,
) -> _Observations:
    cameras = known.cameras()
    x, y, sound = clean_pixels(pixels)
    healthy = unless_all(cameras.broken == 0)
    sound = both(sound, None if healthy is None else healthy.unsqueeze(-1))
    weighed = weigh(weights, mask, batch=batch, like=pixels, sound=sound)
    finite = weighed.sound
    if not surely_all(finite):
        # What is not finite is an outlier: it has no say in how much the others count.
        good = both(sound, None if weights is None else weights.isfinite())
        weighed = weigh(weights, both(mask, good), batch=batch, like=pixels, sound=None)
    usable, shape = ~weighed.unused, (*batch, *pixels.shape[-3:-1])
    counted = unless_all(usable)
    x, y = only(x, counted), only(y, counted)
    rays = product(cameras.inverse[..., :2], torch.stack([x, y], dim=-2))
    rays = rays + cameras.inverse[..., 2:]
    return _Observations(
        proj=cameras.proj.expand(*batch, *cameras.proj.shape[-3:]),
        pixels=torch.stack([x, y], dim=-1).expand(*shape, 2),
        weights=weights,
        squared=weighed.squared.expand(shape),
        usable=usable.expand(shape),
        finite=finite.expand(*batch, shape[-1]),
        centers=cameras.centers.expand(*batch, *cameras.centers.shape[-2:]),
        directions=rays.transpose(-3, -2).expand(*batch, -1, -1, -1),
    )


class _Best(NamedTuple):
    """The best candidates: ``(*B, V, N)`` bool and ``(*B, N)`` px^2, infinite of none."""

    inliers: Tensor
    cost: Tensor

    def or_cheaper(self, other: "_Best") -> "_Best":
        """Where the other is cheaper, that one."""
        cheaper = other.cost < self.cost
        inliers = torch.where(cheaper.unsqueeze(-2), other.inliers, self.inliers)
        return _Best(inliers, torch.where(cheaper, other.cost, self.cost))


def _consensus(
    known: KnownCameras, threshold: float, min_inliers: int, max_pairs: int, *tensors: Any
) -> tuple[Tensor, Tensor]:
    """Inliers ``(*B, V, N)``, and where there are none the status that says why ``(*B, N)``."""
    observed, limit = _Observations(*tensors), threshold * threshold

    def solved(used: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The point of these views as a candidate ``(*B, 3, 1, N)``, is it valid, its status."""
        points, status = Call(known, observed.pixels, observed.weights, used, "rig").solved()
        return points.mT.unsqueeze(-2), ok(status).unsqueeze(-2), status

    used = observed.usable
    *whole, status = solved(used)
    centers = observed.centers.mT.unsqueeze(-1).expand_as(observed.directions)
    lines = torch.cat([centers, observed.directions], dim=-3)
    pairs = pairs_of(used, max_pairs)
    at_once = max(1, _BUDGET // max(1, used.numel()))
    for start in range(0, max(1, pairs[0].shape[-2]), at_once):
        some = (tensor[..., start : start + at_once, :] for tensor in pairs)
        found = points_of_pairs(lines, *some)
        if start == 0:
            points, exist = (torch.cat(both, -2) for both in zip(whole, found, strict=True))
            distance = _distances(observed, points, exist)
            best = _best_of(observed, distance, limit, min_inliers)
            agree = distance[..., 0, :] < limit
        else:
            distance = _distances(observed, *found)
            best = best.or_cheaper(_best_of(observed, distance, limit, min_inliers))
    for _ in range(_ROUNDS):
        # The better point finds inliers that a pair's noise had hidden, or loses some.
        if surely_all(best.inliers == used):
            break
        used = best.inliers
        distance = _distances(observed, *solved(used)[:2])
        best = best.or_cheaper(_best_of(observed, distance, limit, min_inliers))
        agree = distance.squeeze(-2) < limit
    # An inlier is within the threshold of the point that the inliers have, or there are none.
    true = (agree | ~best.inliers).all(dim=-2, keepdim=True)
    reason = torch.where(ok(status), int(Status.TOO_FEW_VIEWS), status)
    explained = observed.finite | (observed.usable.sum(dim=-2) >= 2)
    return best.inliers & true, torch.where(explained, reason, int(Status.NOT_FINITE_INPUT))


def _distances(observed: _Observations, points: Tensor, exist: Tensor) -> Tensor:
    """Squared distances ``(*B, V, C, N)`` px^2 of candidates ``(*B, 3, C, N)``.

    Infinite behind a view, of what does not exist ``(*B, C, N)``, and of what is too far to.
    """
    exist = exist & (points.abs() < torch.finfo(points.dtype).max ** 0.25).all(dim=-3)
    existing = unless_all(exist.unsqueeze(-3))
    points = only(points, existing)
    views, shape = observed.usable.shape[-2], points.shape[-2:]
    rows = observed.proj.flatten(-3, -2)  # (*B, 3 V, 4): one product for all
    seen = product(rows[..., :3], points.flatten(-2)) + rows[..., 3:]
    x, y, z = seen.reshape(*seen.shape[:-2], views, 3, *shape).unbind(dim=-3)
    in_front = unless_all(z > torch.finfo(z.dtype).tiny ** 0.25)
    inverse = only(z, in_front, other=1.0).reciprocal()
    u, v = observed.pixels.unsqueeze(-3).unbind(dim=-1)
    distance = (x * inverse - u).square() + (y * inverse - v).square()
    return only(distance, in_front, existing, other=torch.inf)


def _best_of(observed: _Observations, distance: Tensor, limit: float, min_inliers: int) -> _Best:
    """The best of the candidates of each point, of which these are the distances."""
    agree = observed.usable.unsqueeze(-2) & (distance < limit)
    cost = (observed.squared.unsqueeze(-2) * distance.clamp(max=limit)).sum(dim=-3)
    cost = torch.where(agree.sum(dim=-3) >= min_inliers, cost, torch.inf)
    cheapest, index = cost.min(dim=-2, keepdim=True)
    inliers = agree.gather(-2, index.unsqueeze(-3).expand_as(agree[..., :1, :])).squeeze(-2)
    return _Best(inliers & cheapest.isfinite(), cheapest.squeeze(-2))
