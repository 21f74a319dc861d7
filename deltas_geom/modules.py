"""The operations as modules, for pipelines that are built from modules."""

from collections.abc import Sequence
from typing import ClassVar, Literal

from torch import Tensor, nn

from deltas_geom.cameras.views import PosedViews
from deltas_geom.checks import check_depth_range
from deltas_geom.epipolar.sampling import Samples, check_spread, sample_segments
from deltas_geom.epipolar.segments import epipolar_segments
from deltas_geom.rasterize import SparseDepth, check_drawing, rasterize_depth
from deltas_geom.triangulation.equations import check_settings
from deltas_geom.triangulation.prepared import PreparedTriangulator
from deltas_geom.triangulation.results import Triangulation


class _Fixed(nn.Module):
    """A module without parameters, which prints its settings."""

    settings: ClassVar[tuple[str, ...]]

    def extra_repr(self) -> str:
        """The settings, where a network is printed."""
        return ", ".join(f"{name}={getattr(self, name)!r}" for name in self.settings)


class EpipolarSampler(_Fixed):
    """:func:`epipolar_segments` and :func:`sample_segments` with fixed settings."""

    settings = ("num_samples", "depth_range", "spacing", "offsets")

    def __init__(
        self,
        num_samples: int,
        *,
        depth_range: tuple[float, float],
        spacing: Literal["inv_depth", "pixels"] = "inv_depth",
        offsets: Sequence[float] = (),
    ) -> None:
        super().__init__()
        check_spread(num_samples, spacing, offsets)
        check_depth_range(depth_range)
        self.num_samples = num_samples
        self.depth_range = depth_range
        self.spacing = spacing
        self.offsets = tuple(offsets)

    def forward(self, views: PosedViews, pixels: Tensor, image_size: tuple[int, int]) -> Samples:
        """Samples of the anchor's ``pixels`` (*B, N, 2) in every source."""
        size, count = image_size, self.num_samples
        found = epipolar_segments(views, pixels, depth_range=self.depth_range, image_size=size)
        return sample_segments(
            found, count, spacing=self.spacing, offsets=self.offsets, image_size=size
        )


class Triangulator(_Fixed):
    """:func:`triangulate` with fixed settings."""

    settings = ("frame", "covariance", "max_residual")

    def __init__(
        self,
        *,
        frame: Literal["rig", "world"] = "rig",
        covariance: bool = False,
        max_residual: float | None = None,
    ) -> None:
        super().__init__()
        check_settings(frame, max_residual)
        self.frame = frame
        self.covariance = covariance
        self.max_residual = max_residual

    def forward(
        self,
        proj: Tensor,
        pixels: Tensor,
        weights: Tensor | None = None,
        mask: Tensor | None = None,
    ) -> Triangulation:
        """Points of matched ``pixels`` (*B, V, N, 2)."""
        return self.prepare(proj).full(pixels, weights, mask)

    def prepare(self, proj: Tensor) -> PreparedTriangulator:
        """The same for cameras ``(*B, V, 3, 4)`` that stay: 17 joints then cost a fifth less."""
        return PreparedTriangulator(
            proj, frame=self.frame, covariance=self.covariance, max_residual=self.max_residual
        )


class DepthRasterizer(_Fixed):
    """:func:`rasterize_depth` with fixed settings."""

    settings = ("reduce", "splat")

    def __init__(
        self,
        *,
        reduce: Literal["front", "mean"] = "front",
        splat: Literal["pixel", "bilinear"] = "pixel",
    ) -> None:
        super().__init__()
        check_drawing(reduce, splat)
        self.reduce = reduce
        self.splat = splat

    def forward(
        self,
        pixels: Tensor,
        depth: Tensor,
        image_size: tuple[int, int],
        mask: Tensor | None = None,
        weights: Tensor | None = None,
    ) -> SparseDepth:
        """Sparse depth image of points at ``pixels`` (*B, N, 2)."""
        return rasterize_depth(
            pixels,
            depth,
            image_size=image_size,
            mask=mask,
            weights=weights,
            reduce=self.reduce,
            splat=self.splat,
        )
