"""What an implementation under test offers."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor

from deltas_geom.testing.answers import SIGNATURES, checked

ImageSize = tuple[int, int]
"""(height, width)."""
DepthRange = tuple[float, float]
"""(near, far) along the anchor's z axis, metres."""

Segmenter = Callable[[Tensor, Tensor, Tensor, DepthRange, ImageSize], tuple[Tensor, Tensor, Tensor]]
Sampler = Callable[
    [Tensor, Tensor, Tensor, DepthRange, ImageSize, int], tuple[Tensor, Tensor, Tensor]
]
Drawer = Callable[[Tensor, Tensor, Tensor, ImageSize], tuple[Tensor, Tensor]]

_SOLVERS = "triangulate, judge, refine, residual or robust"
_MADE_OF = {
    "weights": f"weighted=True and {_SOLVERS}",
    "autograd": "differentiable=True",
    "gradients": "triangulate and differentiable=True",
    "batches": "triangulate and batched=True",
    "points": "triangulate, refine or robust",
    "fit": "refine or robust",
    "many views": f"max_views of 3 or more, or None, and {_SOLVERS}",
    "samples": "depth_samples or pixel_samples",
    "drawing": "rasterize, mean_depth or splat",
}
"""The fields behind each feature that is not one function."""


@dataclass(frozen=True)
class Target:
    """An implementation under test, in plain tensors, so that wrapping a function takes a line.

    Conventions are ours (docs/conventions.md): pixels are (x, y) with the top-left pixel's centre
    at (0, 0), an image spans -0.5 ... W - 0.5, ``cam_from_world`` has OpenCV's axes, depth is
    along z. No batch dims. What is left out is not tested.

    Of two views, view 0 is the anchor and view 1 the source. A *status* is either a mask (True =
    there is an answer) or integers of :class:`deltas_geom.Status`, which are then also asked to
    give the right reason.

    Attributes:
        name: head of its column in the table.
        project: ``(K (V, 3, 3), cam_from_world (V, 4, 4), points (N, 3)) -> pixels (V, N, 2)``.
        fundamental: ``(K (2, 3, 3), cam_from_world (2, 4, 4)) -> F (3, 3)`` of any scale and
            sign, with x1^T F x0 = 0 for pixels x0 of view 0 and x1 of view 1.
        triangulate: ``(proj (V, 3, 4), pixels (V, N, 2), weights (V, N) or None) -> points
            (N, 3)`` in the world, metres; ``weights`` multiply the equations, None = all 1.
        max_views: the most views that ``triangulate``, ``judge``, ``refine``, ``residual``,
            ``parallax`` and ``robust`` take; None = any number.
        weighted: whether they heed weights; if not, they are called with None.
        differentiable: whether autograd goes through ``triangulate``, ``project``,
            ``sample_map`` and ``soft_argmax``.
        batched: whether ``triangulate`` takes leading batch dims, broadcast against each other.
        judge: as ``triangulate``, but ``-> status (N)`` of the points.
        refine: ``(proj (V, 3, 4), pixels (V, N, 2), points (N, 3), weights (V, N) or None) ->
            points (N, 3)`` with a smaller weighted sum of squared reprojection errors.
        segments: ``(K (2, 3, 3), cam_from_world (2, 4, 4), pixels (N, 2) of view 0, depth_range,
            image_size) -> (far (N, 2), near (N, 2), status (N))``: both ends, in view 1, of what
            is visible there of the depth range. An empty one is False or EMPTY, a single pixel
            True or NO_PARALLAX; a keypoint that is NaN is False or NOT_FINITE_INPUT.
        depth_samples: ``(K, cam_from_world, pixels, depth_range, image_size, S) -> (pixels
            (N, S, 2), inv_depth (N, S), status (N))``: from the far to the near end of each
            segment, even in inverse depth (of view 0's z, 1/m).
        pixel_samples: the same, even in pixels.
        sweep: ``(K, cam_from_world, pixels (N, 2), inv_depth (S), image_size) -> (pixels
            (N, S, 2), visible (N, S) bool)``: where view 1 sees each inverse depth, 0 included.
        sample_map: ``(feature_map (D, h, w), pixels (N, 2), image_size) -> (N, D)``: a map that
            covers the image in coarser cells, read bilinearly.
        correlate: ``(descriptors (N, D), feature_map (D, h, w), pixels (N, S, 2), image_size) ->
            scores (N, S)``: dot products with the map at places.
        soft_argmax: ``(logits (S), positions (S, D), mask (S) bool) -> (D)``: mean position.
        soft_covariance: as ``soft_argmax``, but ``-> (D, D)``: covariance about that mean.
        heatmap_argmax: ``(logits (h, w)) -> pixel (2)``: mean pixel under the softmax.
        rasterize: ``(pixels (N, 2), depth (N), image_size) -> depth (H, W)``: each point goes to
            the nearest pixel, where the nearest point wins; 0 = no point.
        mean_depth: ``(pixels (N, 2), depth (N), weights (N), image_size) -> (depth (H, W),
            weight (H, W))``: weighted mean and summed weight of each pixel's points.
        splat: the same, each point shared among its four neighbours bilinearly.
        unproject: ``(K (V, 3, 3), cam_from_world (V, 4, 4), pixels (V, N, 2), depth (V, N)) ->
            points (V, N, 3)``: the world points at a depth along each camera's z.
        rays: ``(K (V, 3, 3), pixels (V, N, 2)) -> rays (V, N, 3)`` in each camera's own frame,
            as long as makes z = 1.
        residual: ``(proj (V, 3, 4), pixels (V, N, 2), points (N, 3), weights (V, N) or None) ->
            residual (N)``: RMS distance of projections from pixels, px; of weights, their squares
            count.
        parallax: ``(proj (V, 3, 4), points (N, 3)) -> angle (N)``: the largest angle at which two
            of the views' rays meet, rad.
        robust: ``(proj (V, 3, 4), pixels (V, N, 2), weights (V, N) or None, threshold) ->
            (points (N, 3), inliers (V, N) bool)``: the point of the views that see it within
            ``threshold`` px, and which those are: none where there is no point.
        tolerance: of pixels (px) and points (m). What else is compared is allowed as many times
            more than by default. For what computes in float32, whatever it is given: 3e-3.

    Raises:
        TypeError: what has to be a function, or True or False, is something else.
        ValueError: ``max_views`` is less than 2, or ``tolerance`` is not positive.

    Example:
        >>> from deltas_geom.triangulation.triangulate import triangulate_points
        >>> mine = Target("mine", triangulate=triangulate_points, max_views=2, weighted=False)
        >>> mine.offers("weights"), mine.offers("project")
        (False, False)
    """

    name: str
    project: Callable[[Tensor, Tensor, Tensor], Tensor] | None = None
    fundamental: Callable[[Tensor, Tensor], Tensor] | None = None
    triangulate: Callable[[Tensor, Tensor, Tensor | None], Tensor] | None = None
    max_views: int | None = None
    weighted: bool = True
    differentiable: bool = True
    batched: bool = False
    judge: Callable[[Tensor, Tensor, Tensor | None], Tensor] | None = None
    refine: Callable[[Tensor, Tensor, Tensor, Tensor | None], Tensor] | None = None
    segments: Segmenter | None = None
    depth_samples: Sampler | None = None
    pixel_samples: Sampler | None = None
    sweep: Callable[[Tensor, Tensor, Tensor, Tensor, ImageSize], tuple[Tensor, Tensor]] | None = (
        None
    )
    sample_map: Callable[[Tensor, Tensor, ImageSize], Tensor] | None = None
    correlate: Callable[[Tensor, Tensor, Tensor, ImageSize], Tensor] | None = None
    soft_argmax: Callable[[Tensor, Tensor, Tensor], Tensor] | None = None
    soft_covariance: Callable[[Tensor, Tensor, Tensor], Tensor] | None = None
    heatmap_argmax: Callable[[Tensor], Tensor] | None = None
    rasterize: Callable[[Tensor, Tensor, ImageSize], Tensor] | None = None
    mean_depth: Drawer | None = None
    splat: Drawer | None = None
    unproject: Callable[[Tensor, Tensor, Tensor, Tensor], Tensor] | None = None
    rays: Callable[[Tensor, Tensor], Tensor] | None = None
    residual: Callable[[Tensor, Tensor, Tensor, Tensor | None], Tensor] | None = None
    parallax: Callable[[Tensor, Tensor], Tensor] | None = None
    robust: Callable[[Tensor, Tensor, Tensor | None, float], tuple[Tensor, Tensor]] | None = None
    tolerance: float = 1e-6

    def __post_init__(self) -> None:
        if not isinstance(self.name, str):
            raise TypeError(f"name must be a str, got {type(self.name).__name__}")
        for field in SIGNATURES:
            function = getattr(self, field)
            if function is not None and not callable(function):
                kind = type(function).__name__
                raise TypeError(f"{field} must be a function or None, got {kind}")
        for field in ("weighted", "differentiable", "batched"):
            if not isinstance(getattr(self, field), bool):
                raise TypeError(f"{field} must be True or False, got {getattr(self, field)!r}")
        if self.max_views is not None and not isinstance(self.max_views, int):
            raise TypeError(f"max_views must be whole, or None, got {self.max_views!r}")
        if self.max_views is not None and self.max_views < 2:
            raise ValueError(f"max_views must be 2 or more, or None, got {self.max_views}")
        if not isinstance(self.tolerance, float | int):
            raise TypeError(f"tolerance must be a number, got {self.tolerance!r}")
        if not 0 < self.tolerance < math.inf:
            raise ValueError(f"tolerance must be positive and finite, got {self.tolerance}")

    def offers(self, feature: str) -> bool:
        """Whether there is something to test.

        Args:
            feature: the name of a function above, or of what goes with some of them: "weights"
                and "many views" (three and more) of what has points and pixels, "gradients" and
                "batches" of triangulation, "points" (found in any of three ways), "fit" (in two),
                "autograd" of anything, "samples" (of either spacing), "drawing" (of depth, in any
                of three ways).
        """
        solves = any((self.triangulate, self.judge, self.refine, self.residual, self.robust))
        more = {
            "weights": solves and self.weighted,
            "autograd": self.differentiable,
            "gradients": self.triangulate is not None and self.differentiable,
            "batches": self.triangulate is not None and self.batched,
            "many views": solves and (self.max_views is None or self.max_views >= 3),
            "points": any((self.triangulate, self.refine, self.robust)),
            "fit": any((self.refine, self.robust)),
            "samples": self.depth_samples is not None or self.pixel_samples is not None,
            "drawing": any((self.rasterize, self.mean_depth, self.splat)),
        }
        if feature in more:
            return more[feature]
        function: object = getattr(self, feature)
        return function is not None

    def checked(self, remarks: list[str] | None = None) -> "Target":
        """The same, whose functions raise unless answers are what :func:`answers.checked` asks.

        Args:
            remarks: what a failing comparison may come from is added here.

        Example:
            >>> import torch
            >>> listed = Target("mine", heatmap_argmax=lambda logits: [0.0, 0.0])
            >>> listed.checked().heatmap_argmax(torch.zeros(2, 3))
            Traceback (most recent call last):
            ...
            TypeError: mine: heatmap_argmax must return a torch.Tensor, pixel (2), got list
        """
        heard = [] if remarks is None else remarks
        functions: dict[str, Any] = {
            field: checked(self.name, field, getattr(self, field), heard)
            for field in SIGNATURES
            if getattr(self, field) is not None
        }
        return replace(self, **functions)


def fields_of(feature: str) -> str:
    """What a target has to be given for a feature of :meth:`Target.offers`, in words."""
    return _MADE_OF.get(feature, feature)
