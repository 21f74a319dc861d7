"""Arguments of any operation that are empty or of a wrong kind: an answer or an error in words."""

import inspect
import re
from collections.abc import Callable
from typing import Any

import operations
import pytest
import torch
from operations import METHODS, OPERATIONS, RANGE, SIZE, at_depths, chosen, inputs_in
from torch import Tensor

import deltas_geom as geom

ALL_INPUTS = inputs_in(torch.float32)
NO_PROJ, NO_PIXELS, NO_RAYS = torch.zeros(0, 3, 4), torch.zeros(0, 2, 2), torch.zeros(0, 2, 3)
NO_VIEWS = geom.PosedViews(torch.zeros(0, 3, 3), torch.zeros(0, 4, 4))
POINTS, NO_WEIGHTS = torch.zeros(2, 3), torch.zeros(0, 2)

WITHOUT_VIEWS: dict[str, Callable[[], Any]] = {
    "epipolar_segments": lambda: geom.epipolar_segments(
        NO_VIEWS, torch.zeros(2, 2), depth_range=RANGE, image_size=SIZE
    ),
    "point_covariance": lambda: geom.point_covariance(NO_PROJ, POINTS, NO_WEIGHTS),
    "ray_parallax": lambda: geom.ray_parallax(NO_PROJ, POINTS, NO_WEIGHTS > 0),
    "refine_points": lambda: geom.refine_points(NO_PROJ, NO_PIXELS, POINTS),
    "reprojection_residual": lambda: geom.reprojection_residual(
        NO_PROJ, POINTS, NO_PIXELS, NO_WEIGHTS
    ),
    "sample_inv_depths": lambda: geom.sample_inv_depths(
        NO_VIEWS, torch.zeros(2, 2), torch.ones(4), image_size=SIZE
    ),
    "triangulate": lambda: geom.triangulate(NO_PROJ, NO_PIXELS),
    "triangulate, weights": lambda: geom.triangulate(NO_PROJ, NO_PIXELS, NO_WEIGHTS),
    "triangulate_midpoint": lambda: geom.triangulate_midpoint(NO_VIEWS.cam_from_world, NO_RAYS),
    "triangulate_points": lambda: geom.triangulate_points(NO_PROJ, NO_PIXELS),
    "triangulate_rays": lambda: geom.triangulate_rays(NO_VIEWS.cam_from_world, NO_RAYS),
    "triangulate_robust": lambda: geom.triangulate_robust(NO_PROJ, NO_PIXELS),
    "triangulate_two_view": lambda: geom.triangulate_two_view(NO_PROJ, NO_PIXELS),
}


@pytest.mark.parametrize("name", WITHOUT_VIEWS)
def test_without_views_there_is_an_error_in_words(name: str) -> None:
    with pytest.raises(geom.ShapeError, match=r"must have (V >= 1|shape \(\*B, 2)"):
        WITHOUT_VIEWS[name]()


ONE_K = torch.tensor([[[300.0, 0, 160], [0, 300, 120], [0, 0, 1]]])
OF_VIEWS: dict[str, Callable[[geom.PosedViews, tuple[int, ...]], Any]] = {
    "epipolar_segments": lambda views, batch: geom.epipolar_segments(
        views, torch.zeros(*batch, 6, 2), depth_range=RANGE, image_size=SIZE
    ),
    "fundamental_between": lambda views, _: geom.fundamental_between(views),
    "project": lambda views, batch: geom.project(views, torch.zeros(*batch, 6, 3)),
    "sample_inv_depths": lambda views, batch: geom.sample_inv_depths(
        views, torch.zeros(*batch, 6, 2), torch.ones(4), image_size=SIZE
    ),
    "unproject": lambda views, batch: geom.unproject(
        views, torch.zeros(*batch, 5, 6, 2), torch.ones(*batch, 5, 6)
    ),
}


@pytest.mark.parametrize("name", OF_VIEWS)
def test_cameras_that_do_not_go_together_are_an_error_in_words(name: str) -> None:
    poses, K = torch.eye(4).repeat(5, 1, 1), ONE_K.repeat(5, 1, 1)
    operation = OF_VIEWS[name]
    for one in (ONE_K, ONE_K[0]):
        with pytest.raises(geom.ShapeError, match=r"one K of all views pass K.expand\(5, 3, 3\)"):
            operation(geom.PosedViews(one, poses), ())
    for wrong in (poses[:3], poses[0], poses[:, :3]):
        with pytest.raises(geom.ShapeError, match="cam_from_world"):
            operation(geom.PosedViews(K, wrong), ())
    with pytest.raises(geom.ShapeError, match=r"must broadcast, got \(3,\), \(2,\)"):
        operation(geom.PosedViews(K.repeat(3, 1, 1, 1), poses.repeat(2, 1, 1, 1)), ())
    if name != "fundamental_between":
        with pytest.raises(geom.ShapeError, match=r"must broadcast, got \(3,\), \(2,\)"):
            operation(geom.PosedViews(K.repeat(3, 1, 1, 1), poses), (2,))
    operation(geom.PosedViews(K.repeat(3, 1, 1, 1), poses), (2, 1))


def test_without_places_or_pixels_of_a_map_there_is_an_error_in_words() -> None:
    with pytest.raises(geom.ShapeError, match="logits must have S >= 1"):
        geom.soft_argmax(torch.zeros(3, 0), torch.zeros(3, 0, 2))
    with pytest.raises(geom.ShapeError, match="feature_map must have h >= 1"):
        geom.sample_map(torch.zeros(5, 0, 4), torch.zeros(2, 2), image_size=SIZE)
    given = chosen(OPERATIONS["correlate"], inputs_in(torch.float32))
    with pytest.raises(geom.ShapeError, match="feature_map must have w >= 1"):
        OPERATIONS["correlate"](**given | {"maps": given["maps"][..., :0]})


SIZED = {
    name: operation
    for name, operation in (OPERATIONS | METHODS).items()
    if "image_size" in inspect.signature(getattr(geom, name.split(",")[0], chosen)).parameters
    or name in ("EpipolarSampler", "DepthRasterizer", "kornia", "from_pytorch3d", "resize")
    or name in ("resize_intrinsics", "resize_pixels")
}


@pytest.mark.parametrize("name", SIZED)
def test_a_size_that_is_none_is_an_error_in_words(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for size, kind in (((0, 5), ValueError), ((4.5, 6.0), TypeError), (7, ValueError)):
        monkeypatch.setattr(operations, "SIZE", size)
        with pytest.raises(kind, match=r"^image_size must "):
            SIZED[name](**chosen(SIZED[name], ALL_INPUTS))


def masked_soft_argmax(weights: Tensor, pixels: Tensor, mask: Tensor) -> Any:
    return geom.soft_argmax(weights, pixels, mask=mask)


def masked_joint(
    K: Tensor, poses: Tensor, keypoints: Tensor, inv_depths: Tensor, scores: Tensor, mask: Tensor
) -> Any:
    samples = at_depths(K, poses, keypoints, inv_depths)._replace(mask=mask[1:, :, None, None])
    views = geom.PosedViews(K, poses)
    return geom.match_joint(views, keypoints, scores[..., :1, :], samples, image_size=SIZE)


MASKED = {name: each for name, each in OPERATIONS.items() if "mask" in chosen(each, ALL_INPUTS)}
MASKED |= {"soft_argmax": masked_soft_argmax, "match_joint": masked_joint}


@pytest.mark.parametrize("name", MASKED)
def test_a_mask_of_numbers_is_an_error_in_words(name: str) -> None:
    given = chosen(MASKED[name], ALL_INPUTS)
    with pytest.raises(TypeError, match=r"(mask|used) must be bool, .* got torch\.float32"):
        MASKED[name](**given | {"mask": given["mask"].float()})


@pytest.mark.parametrize("kind", [torch.float32, torch.bool], ids=str)
def test_indices_of_tracks_are_integers(kind: torch.dtype) -> None:
    proj, pixels, index = torch.eye(3, 4).repeat(2, 1, 1), torch.zeros(2, 2), torch.tensor([0, 1])
    with pytest.raises(TypeError, match="camera_index must hold integers"):
        geom.triangulate_tracks(proj, pixels, index.to(kind), index, 2)
    with pytest.raises(TypeError, match="point_index must hold integers"):
        geom.triangulate_tracks(proj, pixels, index, index.to(kind), 2)
    for wrong, told in (
        (index + 1, "2 of observation 1$"),
        (index - 1, "-1 of observation 0: leav"),
    ):
        for kind in (torch.int64, torch.int8):
            with pytest.raises(IndexError, match=f"camera_index must be from 0 to 1, got {told}"):
                geom.triangulate_tracks(proj, pixels, wrong.to(kind), index, 2)
            with pytest.raises(IndexError, match=f"point_index must be from 0 to 1, got {told}"):
                geom.triangulate_tracks(proj, pixels, index, wrong.to(kind), 2)


PROJ, PIXELS = torch.eye(3, 4).expand(2, 3, 4), torch.zeros(2, 6, 2)
POSED = geom.PosedViews(torch.eye(3).expand(2, 3, 3), torch.eye(4).expand(2, 4, 4))


def segments_of(g: Any) -> Any:
    return g.epipolar_segments(POSED, PIXELS[0], depth_range=(0.5, 9.0), image_size=SIZE)


OF_OTHER_KIND: dict[str, Callable[[Any], Any]] = {
    "views must be PosedViews, got Tensor: use PosedViews": lambda g: g.diagnose(PROJ, PIXELS),
    "proj must be a torch.Tensor, got PosedViews": lambda g: g.Triangulator().prepare(POSED),
    "proj must be a torch.Tensor, got ndarray": lambda g: g.Triangulator()(PROJ.numpy(), PIXELS),
    "use proj.float()": lambda g: g.Triangulator().prepare(PROJ.int()),
    "must have shape (*B, V, 3, 4), got (2, 3, 3)": lambda g: g.PreparedTriangulator(POSED.K),
    "frame must be 'rig' or 'world', got 'x'": lambda g: g.Triangulator(frame="x"),
    "max_residual must be positive, got -1": lambda g: g.Triangulator(max_residual=-1),
    "lens must be Lens, got Tensor: use Lens(": lambda g: g.undistort_pixels(POSED.K, PIXELS),
    "samples must be Samples, got Tensor: use sample_segments(...)": lambda g: g.correlate(
        torch.zeros(6, 8), torch.zeros(1, 8, 5, 5), PIXELS, image_size=SIZE
    ),
    "samples must be Samples, got Segments: use sample_segments(": lambda g: g.correlate_normalized(
        torch.zeros(6, 8), torch.zeros(1, 8, 5, 5), segments_of(g), image_size=SIZE
    ),
    "samples must be Samples, got Segments: use sample_segments": lambda g: g.match_per_view(
        PIXELS[0], torch.zeros(1, 6, 1, 3), segments_of(g)
    ),
    "samples must be Samples, got Tensor: use sample_segments": lambda g: g.match_joint(
        POSED, PIXELS[0], torch.zeros(1, 6, 1, 3), PIXELS, image_size=SIZE
    ),
    "segments must be Segments, got Samples: use epipolar_segments(...)": lambda g: (
        g.sample_segments(g.sample_segments(segments_of(g), 3), 3)
    ),
    "points must be a torch.Tensor, got Triangulation: use points.points": lambda g: (
        g.refine_points(PROJ, PIXELS, g.triangulate(PROJ, PIXELS))
    ),
    "pixels must be a torch.Tensor, got Projection: use pixels.pixels": lambda g: g.triangulate(
        PROJ, g.project(POSED, torch.ones(6, 3))
    ),
    "use cam_from_world.cam_from_world": lambda g: g.triangulate_rays(POSED, torch.ones(2, 6, 3)),
    "got Segments: use one of its fields, start, end, inv_depth_start,": lambda g: g.triangulate(
        PROJ, segments_of(g)
    ),
    "covariance must be a torch.Tensor": lambda g: g.depth_variance(PROJ, None),
    "image_size must be (height, width)": lambda g: g.pixel_grid((3, 4, 5)),
    "must be (height, width) >= (1, 1), got (0, 2)": lambda g: g.resize_pixels(
        PIXELS, old_size=(0, 2), new_size=(2, 2)
    ),
    "mode must be 'bilinear' or 'nearest', got 'x'": lambda g: g.undistort_image(
        g.Lens(POSED.K, torch.zeros(0), "PINHOLE"), torch.zeros(3, 4, 4), mode="x"
    ),
    "depth_range must be (near, far)": lambda g: g.triangulate(PROJ, PIXELS).within_depth(10.0),
    "proj must be a torch.Tensor, got NoneType": lambda g: g.triangulate(None, PIXELS),
    "rays must be a torch.Tensor, got NoneType": lambda g: g.triangulate_rays(POSED[1], None),
    "point_index must be a torch.Tensor, got NoneType": lambda g: g.triangulate_tracks(
        PROJ, PIXELS[0, :2], torch.arange(2), None, 1
    ),
    "weights must be a torch.Tensor, got NoneType": lambda g: g.track_covariance(
        PROJ, PIXELS[..., :1, 0], torch.arange(2), torch.arange(2), None
    ),
    "steps must be whole, got 1.5": lambda g: g.refine_points(
        PROJ, PIXELS, torch.ones(6, 3), steps=1.5
    ),
    "min_inliers must be whole, got 2.5": lambda g: g.triangulate_robust(
        PROJ, PIXELS, min_inliers=2.5
    ),
    "max_pairs must be whole, got 9.0": lambda g: g.triangulate_robust(PROJ, PIXELS, max_pairs=9.0),
    "num_points must be whole, got 1.0": lambda g: g.triangulate_tracks(
        PROJ, PIXELS[0, :2], torch.arange(2), torch.arange(2), 1.0
    ),
    "window must be whole, got 1.5": lambda g: g.soft_argmax(
        torch.zeros(3), torch.zeros(3, 1), window=1.5
    ),
    "num_samples must be whole, got 8.0": lambda g: g.EpipolarSampler(8.0, depth_range=RANGE),
    "depth_range must be (near, far) with": lambda g: g.EpipolarSampler(8, depth_range=(2, 1)),
    "offsets must be finite, got (nan,)": lambda g: g.EpipolarSampler(
        8, depth_range=RANGE, offsets=(float("nan"),)
    ),
    "spacing must be 'inv_depth' or 'pixels', got 'x'": lambda g: g.EpipolarSampler(
        8, depth_range=RANGE, spacing="x"
    ),
    "reduce must be 'front' or 'mean', got 'x'": lambda g: g.DepthRasterizer(reduce="x"),
    "splat must be 'pixel' or 'bilinear', got 'x'": lambda g: g.DepthRasterizer(splat="x"),
    "tolerance must not be negative, got -1": lambda g: g.is_rigid(POSED[1], tolerance=-1),
    "samples has sources = 1 but feature_map has sources = 2": lambda g: g.correlate(
        torch.zeros(6, 8),
        torch.zeros(2, 8, 5, 5),
        g.sample_inv_depths(POSED, PIXELS[0], torch.ones(3), image_size=SIZE),
        image_size=SIZE,
    ),
}


@pytest.mark.parametrize("words", OF_OTHER_KIND)
def test_what_is_of_another_kind_is_an_error_in_words(words: str) -> None:
    with pytest.raises((TypeError, ValueError), match=re.escape(words)):
        OF_OTHER_KIND[words](geom)
