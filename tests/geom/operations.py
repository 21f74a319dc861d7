"""Every public operation with an example of its arguments, for tests that hold of all of them."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

import deltas_geom as geom
from deltas_geom.testing.fixed_scenes import seeded_scene
from deltas_geom.testing.scenes import IMAGE_SIZE

SIZE = IMAGE_SIZE  # most of the scene is in it
RANGE = (0.5, 10.0)


class Given(NamedTuple):
    """What operations are tried on: 3 views of 6 points, all with gradients."""

    views: geom.PosedViews
    pixels: Tensor
    points: Tensor
    weights: Tensor
    mask: Tensor
    descriptors: Tensor
    maps: Tensor
    scores: Tensor
    inv_depths: Tensor

    @property
    def keypoints(self) -> Tensor:
        return self.pixels[0]

    @property
    def rays(self) -> Tensor:
        return geom.pixel_rays(self.views.K, self.pixels)

    @property
    def segments(self) -> geom.Segments:
        return geom.epipolar_segments(
            self.views, self.keypoints, depth_range=RANGE, image_size=SIZE
        )

    @property
    def beside_lines(self) -> geom.Samples:
        return geom.sample_segments(self.segments, 8, offsets=(-1.0, 0.0, 1.0), image_size=SIZE)

    @property
    def at_depths(self) -> geom.Samples:
        return geom.sample_inv_depths(self.views, self.keypoints, self.inv_depths, image_size=SIZE)


Operation = Callable[[Given], Any]


def _square(given: Given, side: int) -> Tensor:
    """Identity matrices ``(V, N, side, side)`` with gradients."""
    like = given.weights
    identity = torch.eye(side, device=like.device, dtype=like.dtype)
    return identity * like[..., None, None]


def _tracks(given: Given) -> Any:
    views, points = given.weights.shape
    return geom.triangulate_tracks(
        given.views.proj,
        given.pixels.flatten(0, 1),
        torch.arange(views, device=given.pixels.device).repeat_interleave(points),
        torch.arange(points, device=given.pixels.device).repeat(views),
        points,
        given.weights.flatten(),
    )


def _refined(given: Given, **options: Any) -> Any:
    return geom.refine_points(
        given.views.proj, given.pixels, given.points, given.weights, given.mask, steps=2, **options
    )


def _rasterized(given: Given, **options: Any) -> Any:
    return geom.rasterize_depth(
        given.keypoints,
        given.weights[0],
        image_size=SIZE,
        mask=given.mask[0],
        weights=given.weights[1],
        **options,
    )


OPERATIONS: dict[str, Operation] = {
    "camera_centers": lambda g: geom.camera_centers(g.views.cam_from_world),
    "correlate": lambda g: geom.correlate(g.descriptors, g.maps, g.at_depths, image_size=SIZE),
    "correlate, lines": lambda g: geom.correlate(
        g.descriptors, g.maps, g.beside_lines, image_size=SIZE
    ),
    "correlate_normalized": lambda g: geom.correlate_normalized(
        g.descriptors, g.maps, g.at_depths, image_size=SIZE
    ),
    "crop_intrinsics": lambda g: geom.crop_intrinsics(g.views.K, left=2, top=1),
    "depth_variance": lambda g: geom.depth_variance(g.views.proj, _square(g, 3)[0]),
    "epipolar_distance": lambda g: geom.epipolar_distance(
        geom.fundamental_between(g.views), g.pixels[0], g.pixels[1]
    ),
    "epipolar_lines": lambda g: geom.epipolar_lines(geom.fundamental_between(g.views), g.pixels[0]),
    "epipolar_segments": lambda g: g.segments,
    "from_homogeneous": lambda g: geom.from_homogeneous(g.points),
    "fundamental_between": lambda g: geom.fundamental_between(g.views, 0, 2),
    "in_image": lambda g: geom.in_image(g.pixels, image_size=SIZE),
    "invert_pose": lambda g: geom.invert_pose(g.views.cam_from_world),
    "is_rigid": lambda g: geom.is_rigid(g.views.cam_from_world),
    "match_joint": lambda g: geom.match_joint(
        g.views, g.keypoints, g.scores[:, :, :1], g.at_depths, image_size=SIZE
    ),
    "match_per_view": lambda g: geom.match_per_view(g.keypoints, g.scores, g.beside_lines),
    "normalize_pixels": lambda g: geom.normalize_pixels(g.pixels, image_size=SIZE),
    "pixel_grid": lambda g: geom.pixel_grid(SIZE, device=g.pixels.device, dtype=g.pixels.dtype),
    "pixel_rays": lambda g: g.rays,
    "point_covariance": lambda g: geom.point_covariance(g.views.proj, g.points, g.weights),
    "point_covariance, poses": lambda g: geom.point_covariance(
        g.views.proj, g.points, g.weights, pose_covariance=_square(g, 6).sum(dim=1)
    ),
    "project": lambda g: geom.project(g.views, g.points),
    "rasterize_depth": _rasterized,
    "rasterize_depth, mean": partial(_rasterized, reduce="mean", splat="bilinear"),
    "ray_parallax": lambda g: geom.ray_parallax(g.views.proj, g.points, g.mask),
    "refine_points": _refined,
    "refine_points, huber": partial(_refined, loss="huber"),
    "refine_points, implicit": partial(_refined, loss="cauchy", gradient="implicit"),
    "relative_pose": lambda g: geom.relative_pose(*g.views.cam_from_world[:2]),
    "reprojection_residual": lambda g: geom.reprojection_residual(
        g.views.proj, g.points, g.pixels, g.weights
    ),
    "resize_intrinsics": lambda g: geom.resize_intrinsics(
        g.views.K, old_size=SIZE, new_size=(24, 32)
    ),
    "resize_pixels": lambda g: geom.resize_pixels(g.pixels, old_size=SIZE, new_size=(12, 32)),
    "sample_inv_depths": lambda g: g.at_depths,
    "sample_map": lambda g: geom.sample_map(g.maps, g.pixels[1:], image_size=SIZE),
    "sample_segments": lambda g: g.beside_lines,
    "sample_segments, pixels": lambda g: geom.sample_segments(g.segments, 8, spacing="pixels"),
    "soft_argmax": lambda g: geom.soft_argmax(g.scores[0, :, 0], g.inv_depths[:, None], window=2),
    "to_homogeneous": lambda g: geom.to_homogeneous(g.pixels),
    "triangulate": lambda g: geom.triangulate(
        g.views.proj, g.pixels, g.weights, g.mask, covariance=True
    ),
    "triangulate, alike": lambda g: geom.triangulate(g.views.proj, g.pixels),
    "triangulate, world": lambda g: geom.triangulate(
        g.views.proj, g.pixels, g.weights, frame="world"
    ),
    "triangulate_inverse_depth_weighted": lambda g: geom.triangulate_inverse_depth_weighted(
        g.views.cam_from_world, g.rays, g.weights, g.mask
    ),
    "triangulate_midpoint": lambda g: geom.triangulate_midpoint(
        g.views.cam_from_world, g.rays, g.weights, g.mask
    ),
    "triangulate_points": lambda g: geom.triangulate_points(g.views.proj, g.pixels),
    "triangulate_points, weights": lambda g: geom.triangulate_points(
        g.views.proj, g.pixels, g.weights, g.mask
    ),
    "triangulate_rays": lambda g: geom.triangulate_rays(
        g.views.cam_from_world, g.rays, g.weights, g.mask
    ),
    "triangulate_robust": lambda g: geom.triangulate_robust(
        g.views.proj, g.pixels, g.weights, g.mask, covariance=True
    ),
    "triangulate_tracks": _tracks,
    "triangulate_two_view": lambda g: geom.triangulate_two_view(
        g.views.proj[:2], g.pixels[:2], g.mask[:2]
    ),
    "unproject": lambda g: geom.unproject(g.views, g.pixels, g.weights),
    "weights_from_covariance": lambda g: geom.weights_from_covariance(_square(g, 2)),
}
"""By name, and what is special after a comma."""

METHODS: dict[str, Operation] = {
    "proj": lambda g: g.views.proj,
    "select": lambda g: g.views.select(0),
    "from_opengl": lambda g: geom.PosedViews.from_opengl(*g.views),
    "from_world_from_cam": lambda g: geom.PosedViews.from_world_from_cam(*g.views),
    "resize": lambda g: g.views.resize(old_size=SIZE, new_size=(24, 32)),
    "crop": lambda g: g.views.crop(left=2, top=1),
    "EpipolarSampler": lambda g: geom.EpipolarSampler(8, depth_range=RANGE)(
        g.views, g.keypoints, SIZE
    ),
    "Triangulator": lambda g: geom.Triangulator()(g.views.proj, g.pixels, g.weights, g.mask),
    "DepthRasterizer": lambda g: geom.DepthRasterizer()(g.keypoints, g.weights[0], SIZE),
    "kornia": lambda g: geom.PosedViews.from_kornia(g.views.to_kornia(image_size=SIZE)),
}


def given_in(dtype: torch.dtype) -> Given:
    """Inputs of all operations, the same whatever the dtype but for rounding."""
    scene = seeded_scene(3, num_views=3, num_points=6)
    generator = torch.Generator().manual_seed(0)

    def drawn(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator).to(dtype).requires_grad_()

    return Given(
        geom.PosedViews(*(tensor.to(dtype).requires_grad_() for tensor in scene.views)),
        scene.pixels.to(dtype).requires_grad_(),
        scene.points.to(dtype).requires_grad_(),
        drawn(3, 6),
        torch.ones(3, 6, dtype=torch.bool),
        drawn(6, 5),
        drawn(2, 5, 12, 16),
        drawn(2, 6, 3, 8),
        torch.linspace(0.1, 2, 8, dtype=dtype),
    )
