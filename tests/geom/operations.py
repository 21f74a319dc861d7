"""Every public function of named inputs, and every record, for tests that hold of all of them."""

import inspect
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves

import deltas_geom as geom
from deltas_geom import PosedViews
from deltas_geom.testing.fixed_scenes import seeded_scene
from deltas_geom.testing.scenes import IMAGE_SIZE as SIZE  # most of the scene is in it

RANGE = (0.5, 10.0)
Inputs = dict[str, Tensor]
Operation = Callable[..., Any]


def inputs_in(dtype: torch.dtype, num: int = 6) -> Inputs:
    """Three views of ``num`` points without batch dims; the same in each dtype but for rounding."""
    scene = seeded_scene(3, num_views=3, num_points=max(num, 1), noise=0.5)
    generator = torch.Generator().manual_seed(0)

    def drawn(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    views, pixels, points = scene.views, scene.pixels[:, :num], scene.points[:num]
    segments = geom.epipolar_segments(views, pixels[0], depth_range=RANGE, image_size=SIZE)
    square, maps = drawn(num, 3, 3), drawn(2, 5, 12, 16)
    found: Inputs = {
        "K": views.K,
        "poses": views.cam_from_world,
        "pose": views.cam_from_world[0],
        "other_pose": views.cam_from_world[1],
        "proj": views.proj,
        "fundamental": 1e4 * geom.fundamental_between(views),
        "pixels": pixels,
        "keypoints": pixels[0],
        "matched": pixels[1],
        "points": points,
        "rays": geom.pixel_rays(views.K, pixels),
        "weights": 0.3 + drawn(3, num),
        "depth": geom.project(views, points).depth,
        "own_depth": geom.project(views, points).depth[0],
        "own_weights": 0.3 + drawn(num),
        "homogeneous": geom.to_homogeneous(pixels[0]),
        "covariance": square @ square.mT + torch.eye(3),
        "spread": square[:, :2, :2] @ square[:, :2, :2].mT + torch.eye(2),
        "own_points": torch.cat([0.3 * drawn(num, 2) - 0.1, 0.8 + drawn(num, 1)], dim=-1),
        "coefficients": torch.tensor([-0.1, 0.02, 1e-3, -2e-3]),
        "ndc": 0.3 * drawn(3, 4),
        "one_K": views.K[0],
        "small_K": torch.tensor([[9.0, 0.2, 8.0], [0, 10, 5.5], [0, 0, 1]]),
        "new_K": torch.tensor([[3.0, 0.0, 2.4], [0, 4, 2.1], [0, 0, 1]]),
        "pose_spread": 1e-6 * torch.eye(6).expand(3, 6, 6),
        "descriptors": drawn(num, 5),
        "maps": maps,
        "image": maps[0],
        "scores": drawn(2, num, 3, 8),
        "logits": drawn(num, 8),
        "positions": drawn(num, 8, 2),
        "places": pixels[1:, :, None, None] + torch.arange(8)[:, None],
        "inv_depths": torch.linspace(0.1, 2, 8).expand(num, 8),
    }
    found |= {name: tensor for name, tensor in segments._asdict().items() if name != "status"}
    found = {name: tensor.to(dtype).contiguous() for name, tensor in found.items()}
    return found | {"mask": torch.ones(3, num, dtype=torch.bool)}


def along_lines(K: Tensor, poses: Tensor, keypoints: Tensor) -> geom.Samples:
    sampler = geom.EpipolarSampler(8, depth_range=RANGE, offsets=(-1.0, 0.0, 1.0))
    return sampler(PosedViews(K, poses), keypoints, SIZE)


def at_depths(K: Tensor, poses: Tensor, keypoints: Tensor, inv_depths: Tensor) -> geom.Samples:
    return geom.sample_inv_depths(PosedViews(K, poses), keypoints, inv_depths, image_size=SIZE)


def samples_at(places: Tensor, mask: Tensor) -> geom.Samples:
    masks = mask[..., 1:, :, None, None]
    masks = masks.expand(torch.broadcast_shapes(masks.shape, places.shape[:-1]))
    return geom.Samples(places, places[..., 0, :, 0], masks)


def sampled(
    start: Tensor,
    end: Tensor,
    inv_depth_start: Tensor,
    inv_depth_end: Tensor,
    foreshortening: Tensor,
    **options: Any,
) -> geom.Samples:
    numbers = [start[..., 0], end[..., 0], inv_depth_start, inv_depth_end, foreshortening]
    *_, low, high, ratio = torch.broadcast_tensors(*numbers)
    start, end = (ends.expand(*ratio.shape, 2) for ends in (start, end))
    status = torch.zeros_like(ratio, dtype=torch.int8)
    return geom.sample_segments(
        geom.Segments(start, end, low, high, status, ratio), 4, image_size=SIZE, **options
    )


def listed(function: Operation, proj: Tensor, weights: Tensor, **more: Tensor) -> Any:
    """A function of tracks of the cameras and points of every item of a batch, all in one list.

    The fields of what it returns are by item again.
    """
    dims = {"pixels": -3, "points": -2, "pose_covariance": -3}
    shapes = [proj.shape[:-3], weights.shape[:-2], *(x.shape[: dims[k]] for k, x in more.items())]
    batch, (views, num) = torch.broadcast_shapes(*shapes), weights.shape[-2:]
    size = batch.numel()

    def flat(values: Tensor, dim: int, kept: int) -> Tensor:
        return values.expand(*batch, *values.shape[dim:]).reshape(-1, *values.shape[-kept:][:kept])

    lists = {k: flat(x, dims[k], 2 if k == "pose_covariance" else 1) for k, x in more.items()}
    camera = torch.arange(size * views, device=proj.device).repeat_interleave(num)
    point = torch.arange(size * num, device=proj.device).reshape(size, 1, num)
    found = function(
        proj=flat(proj, -3, 2),
        camera_index=camera,
        point_index=point.expand(size, views, num).flatten(),
        weights=weights.expand(*batch, views, num).reshape(-1),
        **lists,
        **({} if "points" in lists else {"num_points": size * num, "covariance": True}),
    )

    def by_item(name: str, field: Tensor) -> Tensor:
        seen = name in ("depth", "errors", "used")
        return field.reshape(*batch, *((views,) * seen), num, *field.shape[1:])

    if isinstance(found, Tensor):
        return by_item("", found)
    fields = found._replace(**({"point_index": None} if "point_index" in found._fields else {}))
    named = {k: None if x is None else by_item(k, x) for k, x in fields._asdict().items()}
    return type(found)(**named)


def tracks(proj: Tensor, pixels: Tensor, weights: Tensor) -> Any:
    return listed(geom.triangulate_tracks, proj, weights, pixels=pixels)


def refined(
    proj: Tensor, pixels: Tensor, points: Tensor, weights: Tensor, mask: Tensor, **options: Any
) -> geom.Refined:
    return geom.refine_points(proj, pixels, points, weights, mask, steps=2, **options)


def through(K: Tensor, coefficients: Tensor) -> geom.Lens:
    return geom.Lens(K, coefficients, "OPENCV")


def rasterized(
    keypoints: Tensor, own_depth: Tensor, own_weights: Tensor, mask: Tensor, **options: Any
) -> geom.SparseDepth:
    return geom.rasterize_depth(
        keypoints, own_depth, mask=mask[..., 0, :], weights=own_weights, image_size=SIZE, **options
    )


OPERATIONS: dict[str, Operation] = {
    "camera_centers": lambda pose: geom.camera_centers(pose),
    "correlate": lambda descriptors, maps, places, mask: geom.correlate(
        descriptors, maps, samples_at(places, mask), image_size=SIZE
    ),
    "correlate, lines": lambda descriptors, maps, K, poses, keypoints: geom.correlate(
        descriptors, maps, along_lines(K, poses, keypoints), image_size=SIZE
    ),
    "correlate_normalized": lambda descriptors, maps, places, mask: geom.correlate_normalized(
        descriptors, maps, samples_at(places, mask), image_size=SIZE
    ),
    "crop_intrinsics": lambda K: geom.crop_intrinsics(K, left=2, top=1),
    "depth_variance": lambda proj, covariance: geom.depth_variance(proj, covariance),
    "epipolar_distance": lambda fundamental, keypoints, matched: geom.epipolar_distance(
        fundamental, keypoints, matched
    ),
    "epipolar_lines": lambda fundamental, keypoints: geom.epipolar_lines(fundamental, keypoints),
    "epipolar_segments": lambda K, poses, keypoints: geom.epipolar_segments(
        PosedViews(K, poses), keypoints, depth_range=RANGE, image_size=SIZE
    ),
    "from_homogeneous": lambda homogeneous: geom.from_homogeneous(homogeneous),
    "fundamental_between": lambda K, poses: geom.fundamental_between(PosedViews(K, poses), 0, 2),
    "in_image": lambda pixels: geom.in_image(pixels, image_size=SIZE),
    "invert_pose": lambda pose: geom.invert_pose(pose),
    "is_rigid": lambda pose: geom.is_rigid(pose),
    "match_joint": lambda K, poses, keypoints, scores, inv_depths: geom.match_joint(
        PosedViews(K, poses),
        keypoints,
        scores[..., :1, :],
        at_depths(K, poses, keypoints, inv_depths),
        image_size=SIZE,
    ),
    "match_per_view": lambda keypoints, scores, places, mask: geom.match_per_view(
        keypoints, scores[..., :1, :], samples_at(places, mask)
    ),
    "normalize_pixels": lambda pixels: geom.normalize_pixels(pixels, image_size=SIZE),
    "pixel_grid": lambda pixels: geom.pixel_grid(SIZE, device=pixels.device, dtype=pixels.dtype),
    "pixel_rays": lambda K, pixels: geom.pixel_rays(K, pixels),
    "point_covariance": lambda proj, points, weights: geom.point_covariance(proj, points, weights),
    "point_covariance, poses": lambda proj, points, weights, pose_spread: geom.point_covariance(
        proj, points, weights, pose_covariance=pose_spread
    ),
    "project": lambda K, poses, points: geom.project(PosedViews(K, poses), points),
    "rasterize_depth": rasterized,
    "rasterize_depth, mean": partial(rasterized, reduce="mean", splat="bilinear"),
    "ray_covariance": lambda poses, points, weights: geom.ray_covariance(poses, points, weights),
    "ray_parallax": lambda proj, points, mask: geom.ray_parallax(proj, points, mask),
    "refine_points": refined,
    "refine_points, huber": partial(refined, loss="huber", scale=0.3),
    "refine_points, implicit": partial(refined, loss="cauchy", scale=0.3, gradient="implicit"),
    "refine_rays": lambda poses, rays, points, weights, mask: geom.refine_rays(
        poses, rays, points, weights, mask, steps=2
    ),
    "refine_tracks": lambda proj, pixels, points, weights: listed(
        partial(geom.refine_tracks, steps=2), proj, weights, pixels=pixels, points=points
    ),
    "relative_pose": lambda pose, other_pose: geom.relative_pose(pose, other_pose),
    "reprojection_residual": lambda proj, points, pixels, weights: geom.reprojection_residual(
        proj, points, pixels, weights
    ),
    "resize_intrinsics": lambda K: geom.resize_intrinsics(K, old_size=SIZE, new_size=(24, 32)),
    "resize_pixels": lambda pixels: geom.resize_pixels(pixels, old_size=SIZE, new_size=(12, 32)),
    "sample_inv_depths": at_depths,
    "sample_map": lambda maps, pixels: geom.sample_map(
        maps, pixels[..., 1:, :, :], image_size=SIZE
    ),
    "sample_segments": partial(sampled, offsets=(-1.0, 0.0, 1.0)),
    "sample_segments, pixels": partial(sampled, spacing="pixels"),
    "soft_argmax": lambda logits, positions: geom.soft_argmax(logits, positions, window=2),
    "to_homogeneous": lambda pixels: geom.to_homogeneous(pixels),
    "track_covariance": lambda proj, points, weights, pose_spread: listed(
        geom.track_covariance, proj, weights, points=points, pose_covariance=pose_spread
    ),
    "triangulate": lambda proj, pixels, weights, mask: geom.triangulate(
        proj, pixels, weights, mask, covariance=True
    ),
    "triangulate, alike": lambda proj, pixels: geom.triangulate(proj, pixels, covariance=True),
    "triangulate, world": lambda proj, pixels, weights: geom.triangulate(
        proj, pixels, weights, frame="world", covariance=True
    ),
    "triangulate_inverse_depth_weighted": lambda poses, rays, weights, mask: (
        geom.triangulate_inverse_depth_weighted(poses, rays, weights, mask, covariance=True)
    ),
    "triangulate_midpoint": lambda poses, rays, weights, mask: geom.triangulate_midpoint(
        poses, rays, weights, mask, covariance=True
    ),
    "triangulate_points": lambda proj, pixels: geom.triangulate_points(proj, pixels),
    "triangulate_points, weights": lambda proj, pixels, weights, mask: geom.triangulate_points(
        proj, pixels, weights, mask
    ),
    "triangulate_rays": lambda poses, rays, weights, mask: geom.triangulate_rays(
        poses, rays, weights, mask, covariance=True
    ),
    "triangulate_robust": lambda proj, pixels, weights, mask: geom.triangulate_robust(
        proj, pixels, weights, mask, covariance=True
    ),
    "triangulate_robust_rays": lambda poses, rays, weights, mask: geom.triangulate_robust_rays(
        poses, rays, weights, mask, covariance=True
    ),
    "triangulate_robust_tracks": lambda proj, pixels, weights: listed(
        geom.triangulate_robust_tracks, proj, weights, pixels=pixels
    ),
    "triangulate_tracks": tracks,
    "triangulate_two_view": lambda proj, pixels, mask: geom.triangulate_two_view(
        proj[..., :2, :, :], pixels[..., :2, :, :], mask[..., :2, :], covariance=True
    ),
    "undistort_image": lambda small_K, coefficients, image: geom.undistort_image(
        through(small_K, coefficients), image
    ),
    "undistort_image, K": lambda small_K, coefficients, image, new_K: geom.undistort_image(
        through(small_K, coefficients), image, new_K=new_K, new_size=(5, 6)
    ),
    "undistort_pixels": lambda one_K, coefficients, keypoints: geom.undistort_pixels(
        through(one_K, coefficients), keypoints
    ),
    "unproject": lambda K, poses, pixels, depth: geom.unproject(
        PosedViews(K, poses), pixels, depth
    ),
    "weights_from_covariance": lambda spread: geom.weights_from_covariance(spread),
}
"""By name, and what is special after a comma; parameters are keys of :func:`inputs_in`."""

METHODS: dict[str, Operation] = {
    "proj": lambda K, poses: PosedViews(K, poses).proj,
    "select": lambda K, poses: PosedViews(K, poses).select(0),
    "from_opengl": lambda K, poses: PosedViews.from_opengl(K, poses),
    "from_world_from_cam": lambda K, poses: PosedViews.from_world_from_cam(K, poses),
    "from_pytorch3d": lambda poses, ndc: PosedViews.from_pytorch3d(
        poses[..., :3, :3], poses[..., :3, 3], 1 + ndc[..., :2], ndc[..., 2:], image_size=SIZE
    ),
    "recentred": lambda K, poses: PosedViews(K, poses).recentred(None),
    "resize": lambda K, poses: PosedViews(K, poses).resize(old_size=SIZE, new_size=(24, 32)),
    "crop": lambda K, poses: PosedViews(K, poses).crop(left=2, top=1),
    "EpipolarSampler": along_lines,
    "Triangulator": lambda proj, pixels, weights, mask: geom.Triangulator(covariance=True)(
        proj, pixels, weights, mask
    ),
    "DepthRasterizer": lambda keypoints, own_depth: geom.DepthRasterizer()(
        keypoints, own_depth, SIZE
    ),
    "kornia": lambda K, poses: PosedViews.from_kornia(
        PosedViews(K, poses).to_kornia(image_size=SIZE)
    ),
}

METHODS |= {
    "Lens.project": lambda one_K, coefficients, own_points: through(one_K, coefficients).project(
        own_points
    ),
    "Lens.unproject": lambda one_K, coefficients, keypoints: through(one_K, coefficients).unproject(
        keypoints
    ),
}

RECORDS: dict[str, Operation] = {
    "LensPixels": METHODS["Lens.project"],
    "LensRays": METHODS["Lens.unproject"],
    "Matches": OPERATIONS["match_joint"],
    "PosedViews": lambda K, poses: PosedViews(K, poses),
    "Projection": OPERATIONS["project"],
    "Refined": refined,
    "RobustTriangulation": OPERATIONS["triangulate_robust"],
    "Samples": at_depths,
    "Segments": OPERATIONS["epipolar_segments"],
    "SoftArgmax": OPERATIONS["soft_argmax"],
    "SparseDepth": rasterized,
    "TriangulatedTracks": lambda proj, keypoints, own_weights: geom.triangulate_tracks(
        proj[:2],
        keypoints,
        torch.arange(6) % 2,
        torch.arange(6) // 2,
        3,
        own_weights,
        covariance=True,
    ),
    "Triangulation": OPERATIONS["triangulate"],
    "TwoViewTriangulation": OPERATIONS["triangulate_two_view"],
    "UndistortedImage": OPERATIONS["undistort_image"],
}


def names_of(operation: Operation) -> list[str]:
    """Of the inputs that an operation takes."""
    parameters = inspect.signature(operation).parameters.values()
    options = inspect.Parameter.VAR_KEYWORD
    return [each.name for each in parameters if each.default is each.empty and each.kind != options]


def chosen(operation: Operation, inputs: Inputs) -> Inputs:
    return {name: inputs[name] for name in names_of(operation)}


def tensors_of(result: Any) -> list[Tensor]:
    return [leaf for leaf in tree_leaves(result) if isinstance(leaf, Tensor)]


def is_real(tensor: Tensor) -> bool:
    return tensor.is_floating_point()


def followed(inputs: Inputs) -> Inputs:
    return {
        name: tensor.detach().clone().requires_grad_() if is_real(tensor) else tensor
        for name, tensor in inputs.items()
    }
