"""Key points of the anchors are matched and triangulated, and every step of it is shown."""

import torch
import torch.nn.functional as F
from torch import Tensor

from deltas_nets.config.varied import NetworkSettings
from deltas_nets.network.lite.detector import CELL
from deltas_nets.reference.batch import batch_and_views
from deltas_nets.reference.outputs import MatchOutputs
from deltas_nets.reference.points import triangulate_pixels
from deltas_nets.reference.precision import full_precision
from deltas_nets.reference.scores import MatchNorm, correlate_samples, read_matches
from deltas_nets.reference.segments import reference_segments, segment_samples
from deltas_nets.reference.settings import PUBLISHED


def matched_points(
    norm: MatchNorm,
    descriptors: Tensor,
    keypoints: Tensor,
    intrinsics: Tensor,
    cam_from_anchor: Tensor,
    *,
    probe: Tensor,
    settings: NetworkSettings,
) -> MatchOutputs:
    """Do as :meth:`deltas_nets.reference.ReferenceNetwork.match`, whose other arguments these are.

    Args:
        norm: of the correlation.
        descriptors: ``((1 + V) * B, 128, h, w)`` of unit length.
        keypoints: ``(B, N, 2)`` pixels of the anchors.
        intrinsics: ``(B, 3, 3)``.
        cam_from_anchor: ``(B, V, 4, 4)`` of the sources, metres.
        probe: ``(P,)`` key points to show in detail.
        settings: of the samples; what is not given is as in :data:`PUBLISHED`.

    Raises:
        ShapeError: a shape differs.
    """
    batch, views = batch_and_views(descriptors, keypoints, intrinsics, cam_from_anchor)
    size = (CELL * descriptors.shape[-2], CELL * descriptors.shape[-1])
    given = PUBLISHED.given() | settings.given()
    offset: float = given["offset"]
    with full_precision(keypoints.device):
        segments = reference_segments(keypoints, intrinsics, cam_from_anchor, image_size=size)
        samples = segment_samples(segments, num_samples=given["num_samples"], offset=offset)
        maps = descriptors.view(1 + views, batch, *descriptors.shape[1:]).transpose(0, 1)
        correlation = correlate_samples(maps, keypoints, samples)
        scores = norm(correlation)
        matches = read_matches(scores, segments, offset=offset)
        weights = F.pad(matches.weights, (0, 0, 1, 0), value=1.0)  # the anchor's is 1
        pixels = torch.cat([keypoints[:, None], matches.pixels], dim=1)
        points = triangulate_pixels(pixels, weights, intrinsics, cam_from_anchor)
    return MatchOutputs(
        project_near=segments.near,
        project_far=segments.far,
        in_range=segments.in_range.to(torch.uint8),
        segment_center=segments.center,
        segment_length=segments.length,
        segment_angle=segments.angle,
        probe_grid=samples[:, :, probe],
        probe_corr=correlation[:, :, probe],
        probe_corr_act=scores[:, :, probe],
        matches=matches.pixels,
        confidence=weights.mT,
        probe_dlt=points.system[:, probe].flatten(0, 1),
        dlt_singular_values=points.singular_values.flatten(0, 1),
        points_3d=points.points,
    )
