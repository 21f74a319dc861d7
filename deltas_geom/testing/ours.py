"""Ours as a target: everything, and an example of wrapping operations that take batches."""

from typing import Literal

import torch
from torch import Tensor

from deltas_geom import (
    PosedViews,
    Samples,
    Segments,
    correlate,
    epipolar_segments,
    fundamental_between,
    pixel_grid,
    pixel_rays,
    project,
    rasterize_depth,
    ray_parallax,
    refine_points,
    reprojection_residual,
    sample_inv_depths,
    sample_map,
    sample_segments,
    soft_argmax,
    triangulate,
    triangulate_points,
    triangulate_robust,
    unproject,
)
from deltas_geom.testing.target import DepthRange, Drawer, ImageSize, Sampler, Target


def deltas() -> Target:
    """Ours: everything, with triangulation in the rig frame."""

    def pixels(K: Tensor, cam_from_world: Tensor, points: Tensor) -> Tensor:
        return project(PosedViews(K, cam_from_world), points).pixels

    def fundamental(K: Tensor, cam_from_world: Tensor) -> Tensor:
        return fundamental_between(PosedViews(K, cam_from_world))

    def judge(proj: Tensor, pixels: Tensor, weights: Tensor | None) -> Tensor:
        return triangulate(proj, pixels, weights).status

    def refined(proj: Tensor, pixels: Tensor, points: Tensor, weights: Tensor | None) -> Tensor:
        return refine_points(proj, pixels, points, weights, steps=3).points

    def depth_points(K: Tensor, pose: Tensor, pixels: Tensor, depth: Tensor) -> Tensor:
        return unproject(PosedViews(K, pose), pixels, depth)

    def residual(proj: Tensor, pixels: Tensor, points: Tensor, weights: Tensor | None) -> Tensor:
        equal = torch.ones_like(pixels[..., 0])
        return reprojection_residual(proj, points, pixels, equal if weights is None else weights)

    def parallax(proj: Tensor, points: Tensor) -> Tensor:
        used = torch.ones(proj.shape[0], points.shape[0], dtype=torch.bool)
        return ray_parallax(proj, points, used)

    def robust(
        proj: Tensor, pixels: Tensor, weights: Tensor | None, threshold: float
    ) -> tuple[Tensor, Tensor]:
        found = triangulate_robust(proj, pixels, weights, threshold=threshold)
        return found.points, found.inliers

    def clipped(
        K: Tensor, pose: Tensor, pixels: Tensor, depth_range: DepthRange, image_size: ImageSize
    ) -> Segments:
        views = PosedViews(K, pose)
        return epipolar_segments(views, pixels, depth_range=depth_range, image_size=image_size)

    def segments(
        K: Tensor, pose: Tensor, pixels: Tensor, depth_range: DepthRange, image_size: ImageSize
    ) -> tuple[Tensor, Tensor, Tensor]:
        found = clipped(K, pose, pixels, depth_range, image_size)
        return found.start[0], found.end[0], found.status[0]

    def spread(spacing: Literal["inv_depth", "pixels"]) -> Sampler:
        def samples(
            K: Tensor,
            pose: Tensor,
            pixels: Tensor,
            depth_range: DepthRange,
            image_size: ImageSize,
            count: int,
        ) -> tuple[Tensor, Tensor, Tensor]:
            along = clipped(K, pose, pixels, depth_range, image_size)
            found = sample_segments(along, count, spacing=spacing)
            return found.pixels[0, :, 0], found.inv_depth[0], along.status[0]

        return samples

    def sweep(
        K: Tensor, pose: Tensor, pixels: Tensor, inv_depth: Tensor, image_size: ImageSize
    ) -> tuple[Tensor, Tensor]:
        views = PosedViews(K, pose)
        found = sample_inv_depths(views, pixels, inv_depth, image_size=image_size)
        return found.pixels[0, :, 0], found.mask[0, :, 0]

    def scores(
        descriptors: Tensor, feature_map: Tensor, pixels: Tensor, image_size: ImageSize
    ) -> Tensor:
        places = pixels[None, :, None]
        samples = Samples(
            places, places[:, :, 0, :, 0], torch.ones_like(places[..., 0], dtype=torch.bool)
        )
        return correlate(descriptors, feature_map[None], samples, image_size=image_size)[0, :, 0]

    def heatmap(logits: Tensor) -> Tensor:
        height, width = logits.shape
        grid = pixel_grid((height, width), dtype=logits.dtype)
        return soft_argmax(logits.flatten(), grid).position

    def nearest(pixels: Tensor, depth: Tensor, image_size: ImageSize) -> Tensor:
        return rasterize_depth(pixels, depth, image_size=image_size).depth[0]

    def mean(splat: Literal["pixel", "bilinear"]) -> Drawer:
        def image(
            pixels: Tensor, depth: Tensor, weights: Tensor, image_size: ImageSize
        ) -> tuple[Tensor, Tensor]:
            found = rasterize_depth(
                pixels, depth, image_size=image_size, weights=weights, reduce="mean", splat=splat
            )
            return found.depth[0], found.weight[0]

        return image

    return Target(
        "deltas",
        pixels,
        fundamental,
        triangulate_points,
        batched=True,
        judge=judge,
        refine=refined,
        segments=segments,
        depth_samples=spread("inv_depth"),
        pixel_samples=spread("pixels"),
        sweep=sweep,
        sample_map=lambda m, p, size: sample_map(m, p, image_size=size),
        correlate=scores,
        soft_argmax=lambda x, p, mask: soft_argmax(x, p, mask=mask).position,
        soft_covariance=lambda x, p, mask: soft_argmax(x, p, mask=mask).covariance,
        heatmap_argmax=heatmap,
        rasterize=nearest,
        mean_depth=mean("pixel"),
        splat=mean("bilinear"),
        unproject=depth_points,
        rays=pixel_rays,
        residual=residual,
        parallax=parallax,
        robust=robust,
    )
