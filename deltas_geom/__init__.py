"""Batched, differentiable multi-view geometry for PyTorch.

Posed views, epipolar segments, sampling and matching along them, triangulation, sparse depth.
Conventions: OpenCV axes, ``cam_from_world``, pixel centres at integers, metres.
"""

from deltas_geom.cameras.homogeneous import from_homogeneous, to_homogeneous
from deltas_geom.cameras.lenses.lens import Lens, LensPixels, LensRays
from deltas_geom.cameras.lenses.undistort import UndistortedImage, undistort_image, undistort_pixels
from deltas_geom.cameras.pixels import (
    crop_intrinsics,
    in_image,
    normalize_pixels,
    pixel_grid,
    resize_intrinsics,
    resize_pixels,
)
from deltas_geom.cameras.poses import camera_centers, invert_pose, is_rigid, relative_pose
from deltas_geom.cameras.projection import Projection, pixel_rays, project, unproject
from deltas_geom.cameras.views import PosedViews
from deltas_geom.checks import ShapeError
from deltas_geom.diagnosis.diagnose import diagnose
from deltas_geom.epipolar.fundamental import epipolar_distance, epipolar_lines, fundamental_between
from deltas_geom.epipolar.sampling import Samples, sample_inv_depths, sample_map, sample_segments
from deltas_geom.epipolar.segments import Segments, epipolar_segments
from deltas_geom.matching.correlation import correlate, correlate_normalized
from deltas_geom.matching.matches import (
    Matches,
    SoftArgmax,
    match_joint,
    match_per_view,
    soft_argmax,
    weights_from_covariance,
)
from deltas_geom.modules import DepthRasterizer, EpipolarSampler, Triangulator
from deltas_geom.rasterize import SparseDepth, rasterize_depth
from deltas_geom.status import Status
from deltas_geom.triangulation.aimed import ray_covariance, refine_rays, triangulate_robust_rays
from deltas_geom.triangulation.midpoint import (
    triangulate_inverse_depth_weighted,
    triangulate_midpoint,
)
from deltas_geom.triangulation.prepared import PreparedTriangulator
from deltas_geom.triangulation.rays import triangulate_rays
from deltas_geom.triangulation.refine import Refined, refine_points
from deltas_geom.triangulation.results import RobustTriangulation, Triangulation
from deltas_geom.triangulation.robust import triangulate_robust
from deltas_geom.triangulation.tracked import (
    refine_tracks,
    track_covariance,
    triangulate_robust_tracks,
)
from deltas_geom.triangulation.tracks import TriangulatedTracks, triangulate_tracks
from deltas_geom.triangulation.triangulate import triangulate, triangulate_points
from deltas_geom.triangulation.two_view import TwoViewTriangulation, triangulate_two_view
from deltas_geom.triangulation.uncertainty import (
    depth_variance,
    point_covariance,
    ray_parallax,
    reprojection_residual,
)

__all__ = [
    "DepthRasterizer",
    "EpipolarSampler",
    "Lens",
    "LensPixels",
    "LensRays",
    "Matches",
    "PosedViews",
    "PreparedTriangulator",
    "Projection",
    "Refined",
    "RobustTriangulation",
    "Samples",
    "Segments",
    "ShapeError",
    "SoftArgmax",
    "SparseDepth",
    "Status",
    "TriangulatedTracks",
    "Triangulation",
    "Triangulator",
    "TwoViewTriangulation",
    "UndistortedImage",
    "camera_centers",
    "correlate",
    "correlate_normalized",
    "crop_intrinsics",
    "depth_variance",
    "diagnose",
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
    "ray_covariance",
    "ray_parallax",
    "refine_points",
    "refine_rays",
    "refine_tracks",
    "relative_pose",
    "reprojection_residual",
    "resize_intrinsics",
    "resize_pixels",
    "sample_inv_depths",
    "sample_map",
    "sample_segments",
    "soft_argmax",
    "to_homogeneous",
    "track_covariance",
    "triangulate",
    "triangulate_inverse_depth_weighted",
    "triangulate_midpoint",
    "triangulate_points",
    "triangulate_rays",
    "triangulate_robust",
    "triangulate_robust_rays",
    "triangulate_robust_tracks",
    "triangulate_tracks",
    "triangulate_two_view",
    "undistort_image",
    "undistort_pixels",
    "unproject",
    "weights_from_covariance",
]
