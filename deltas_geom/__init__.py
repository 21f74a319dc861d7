"""Batched, differentiable multi-view geometry for PyTorch.

Posed views, epipolar segments, sampling and matching along them, triangulation, sparse depth.
Conventions: OpenCV axes, ``cam_from_world``, pixel centres at integers, metres.
"""

from deltas_geom.checks import ShapeError
from deltas_geom.fundamental import epipolar_distance, epipolar_lines, fundamental_between
from deltas_geom.homogeneous import from_homogeneous, to_homogeneous
from deltas_geom.matching import (
    Matches,
    SoftArgmax,
    correlate,
    match_joint,
    match_per_view,
    soft_argmax,
)
from deltas_geom.modules import DepthRasterizer, EpipolarSampler, Triangulator
from deltas_geom.pixels import (
    crop_intrinsics,
    in_image,
    normalize_pixels,
    pixel_grid,
    resize_intrinsics,
    resize_pixels,
)
from deltas_geom.poses import camera_centers, invert_pose, is_rigid, relative_pose
from deltas_geom.projection import Projection, pixel_rays, project, unproject
from deltas_geom.rasterize import SparseDepth, rasterize_depth
from deltas_geom.rays import triangulate_rays
from deltas_geom.refine import Refined, refine_points
from deltas_geom.sampling import Samples, sample_inv_depths, sample_map, sample_segments
from deltas_geom.segments import Segments, epipolar_segments
from deltas_geom.status import Status
from deltas_geom.tracks import TriangulatedTracks, triangulate_tracks
from deltas_geom.triangulation import Triangulation, triangulate, triangulate_points
from deltas_geom.uncertainty import point_covariance, ray_parallax, reprojection_residual
from deltas_geom.views import PosedViews

__all__ = [
    "DepthRasterizer",
    "EpipolarSampler",
    "Matches",
    "PosedViews",
    "Projection",
    "Refined",
    "Samples",
    "Segments",
    "ShapeError",
    "SoftArgmax",
    "SparseDepth",
    "Status",
    "TriangulatedTracks",
    "Triangulation",
    "Triangulator",
    "camera_centers",
    "correlate",
    "crop_intrinsics",
    "epipolar_distance",
    "epipolar_lines",
    "epipolar_segments",
    "from_homogeneous",
    "fundamental_between",
    "in_image",
    "invert_pose",
    "is_rigid",
    "match_joint",
    "match_per_view",
    "normalize_pixels",
    "pixel_grid",
    "pixel_rays",
    "point_covariance",
    "project",
    "rasterize_depth",
    "ray_parallax",
    "refine_points",
    "relative_pose",
    "reprojection_residual",
    "resize_intrinsics",
    "resize_pixels",
    "sample_inv_depths",
    "sample_map",
    "sample_segments",
    "soft_argmax",
    "to_homogeneous",
    "triangulate",
    "triangulate_points",
    "triangulate_rays",
    "triangulate_tracks",
    "unproject",
]
