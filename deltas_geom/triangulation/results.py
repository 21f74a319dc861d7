"""Triangulated points, and what is known about each."""

from typing import Any, TypeVar

import torch
from torch import Tensor

from deltas_geom.checks import check_depth_range, check_positive, check_shapes
from deltas_geom.records import Record
from deltas_geom.status import Status

_R = TypeVar("_R", bound=Record)


def within_residual(found: _R, max_residual: float) -> _R:
    """The same without the points about which the views disagree: RESIDUAL_TOO_LARGE.

    They become 0 in every field, as all that failed, but for ``errors``, which tell which
    view is wrong.

    Args:
        max_residual: px, or rad after :func:`deltas_geom.triangulate_rays` and its kin.

    Raises:
        ValueError: it is not positive.
    """
    check_positive(max_residual=max_residual)
    known: Any = found
    kept = without(found, known.residual > max_residual, Status.RESIDUAL_TOO_LARGE)
    return kept._replace(errors=known.errors)


def beyond(depth: Tensor, depth_range: tuple[float, float]) -> Tensor:
    """Which depths are nearer or farther than a range (near, far), metres."""
    check_depth_range(depth_range)
    near, far = depth_range
    return (depth < near) | (depth > far)


def without(found: _R, outside: Tensor, reason: Status) -> _R:
    """Any record of points with those ``outside`` that were valid failed for a reason.

    All its fields are 0 there, but for ``pixels``, which lose their gradient.
    """
    known = found._asdict()
    outside, point = known["valid"] & outside, known.get("point_index")
    seen = outside.unsqueeze(-2) if point is None else outside[point]
    which = dict.fromkeys(("depth", "errors", "inliers", "used"), seen)
    which |= {"points": outside[..., None], "covariance": outside[..., None, None]}
    which["pixels"] = seen[..., None]
    changed: dict[str, Any] = {"status": torch.where(outside, reason.value, known["status"])}
    for name, field in known.items():
        if field is None or name in ("status", "point_index"):
            continue
        mask = which.get(name, outside)
        if field.dtype == torch.bool:
            changed[name] = field & ~mask
        else:
            changed[name] = torch.where(mask, field.detach() if name == "pixels" else 0.0, field)
    return found._replace(**changed)


class Triangulation(Record):
    """Triangulated points and what is known about them.

    Attributes:
        points: ``(*B, N, 3)`` in the world, metres; (0, 0, 0) with zero gradient if not valid.
        depth: ``(*B, V, N)`` along each camera's z axis, metres; 0 if not valid.
        status: ``(*B, N)`` int8 of :class:`Status`.
        valid: ``(*B, N)`` bool, status is OK.
        residual: ``(*B, N)`` weighted RMS distance of the projections from the pixels, px.
        parallax: ``(*B, N)`` largest angle between rays of used views, rad; no gradient.
        covariance: ``(*B, N, 3, 3)`` for pixel noise of standard deviation 1 / weight px, m^2;
            None unless asked for; 0 if not valid, which does not mean exact. It is that of the
            least reprojection error, which one step of :func:`deltas_geom.refine_points` reaches;
            linear solutions scatter a little more.
        errors: ``(*B, V, N)`` distance of each used view's projection from its pixel, px; 0 where
            unused or not valid. It tells which view disagrees with the others.
    """

    points: Tensor
    depth: Tensor
    status: Tensor
    valid: Tensor
    residual: Tensor
    parallax: Tensor
    covariance: Tensor | None
    errors: Tensor

    within_residual = within_residual

    def within_depth(
        self, depth_range: tuple[float, float], *, view: int = 0, used: Tensor | None = None
    ) -> "Triangulation":
        """The same without the points that a view has nearer or farther than a range.

        A slightly wrong match of nearly parallel rays is a point kilometres away, and valid. Where
        one knows better, such points are no longer valid: OUT_OF_RANGE, and 0 in every field, as
        all that failed. After :func:`deltas_geom.triangulate_rays` the range is along the rays.

        Args:
            depth_range: (near, far) metres, both included; far may be infinite.
            view: whose depth counts, whether or not it saw the point: what is behind it, or all
                if the camera is not finite, is out of range. Right for the anchor of a network.
            used: ``(*B, V, N)`` bool, the mask that the points were triangulated with: instead of
                ``view``, every view that saw a point must have it in the range. Right for cameras
                all around.

        Raises:
            ValueError: the range makes no sense.
            IndexError: there is no such view.
            ShapeError, TypeError: ``used`` has another shape, or is not bool.

        Example:
            >>> from deltas_geom import PosedViews, triangulate
            >>> proj = PosedViews(torch.eye(3).expand(2, 3, 3), torch.eye(4).repeat(2, 1, 1)).proj
            >>> proj[1, 0, 3] = -1.0  # one metre to the right
            >>> pixels = torch.tensor([[[0.0, 0.0], [0.0, 0.0]], [[-0.5, 0.0], [-0.001, 0.0]]])
            >>> near_and_far = triangulate(proj, pixels)
            >>> near_and_far.within_depth((0.5, 100.0)).depth[0]
            tensor([2., 0.])
        """
        if used is None:
            outside = beyond(self.depth[..., view, :], depth_range)
        else:
            check_shapes(depth=(self.depth, "V N"), used=(used, "V N"))
            outside = (beyond(self.depth, depth_range) & used).any(dim=-2)
        return without(self, outside, Status.OUT_OF_RANGE)


class RobustTriangulation(Record):
    """The fields of :class:`Triangulation`, of the inliers, and which views those are.

    Attributes:
        points: ``(*B, N, 3)`` in the world, metres; (0, 0, 0) with zero gradient if not valid.
        depth: ``(*B, V, N)`` metres, also in views that are outliers; 0 if not valid.
        status: ``(*B, N)`` int8 of :class:`Status`.
        valid: ``(*B, N)`` bool, status is OK.
        residual: ``(*B, N)`` weighted RMS distance, px.
        parallax: ``(*B, N)`` largest angle, rad; no gradient.
        covariance: ``(*B, N, 3, 3)`` m^2; None unless asked for.
        errors: ``(*B, V, N)`` px, of the inliers.
        inliers: ``(*B, V, N)`` bool, the views used; none if not valid.
    """

    points: Tensor
    depth: Tensor
    status: Tensor
    valid: Tensor
    residual: Tensor
    parallax: Tensor
    covariance: Tensor | None
    errors: Tensor
    inliers: Tensor

    within_residual = within_residual

    def within_depth(self, depth_range: tuple[float, float]) -> "RobustTriangulation":
        """As :meth:`Triangulation.within_depth`, the range being that of every inlier."""
        outside = (beyond(self.depth, depth_range) & self.inliers).any(dim=-2)
        return without(self, outside, Status.OUT_OF_RANGE)


def of_inliers(found: Triangulation, inliers: Tensor, reason: Tensor) -> RobustTriangulation:
    """What is known of points by their inliers ``(*B, V, N)``; why not, where there are none."""
    status = torch.where(inliers.any(dim=-2), found.status, reason)
    inliers = inliers & found.valid.unsqueeze(-2)
    return RobustTriangulation(**found._replace(status=status)._asdict(), inliers=inliers)
