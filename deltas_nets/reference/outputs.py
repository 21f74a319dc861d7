"""What a run of the reference network shows of itself: every intermediate by name."""

from typing import NamedTuple

from torch import Tensor

from deltas_nets.network.paper.superpoint_head import DescriptorStages, DetectorStages
from deltas_nets.network.paper.taps import Taps


class ReferenceFeatures(NamedTuple):
    """What the network sees in B x (1 + V) images: first all anchors, then all first sources.

    Attributes:
        taps: of the image encoder.
        detector: stages of the detector head; ``detector.logits`` are its result.
        descriptor: stages of the descriptor head; ``descriptor.unit`` is its result.
    """

    taps: Taps
    detector: DetectorStages
    descriptor: DescriptorStages


class FeatureOutputs(NamedTuple):
    """Features of one anchor and V sources; fields that end in ``_mean`` are over channels.

    Attributes:
        stem_mean: ``(1 + V, H/2, W/2)`` channel mean of the image encoder's tap.
        layer1_mean: ``(1 + V, H/4, W/4)``.
        layer2_mean: ``(1 + V, H/8, W/8)``.
        layer3_mean: ``(1 + V, h, w)`` at 1/16, rounded up.
        layer4_mean: ``(1 + V, h, w)`` at 1/32, rounded up.
        det_upsampled_mean: ``(1 + V, H/8, W/8)`` of :class:`DetectorStages`.
        detector_logits: ``(1 + V, 65, H/8, W/8)``.
        desc_fuse1_in_mean: ``(1 + V, H/8, W/8)`` of :class:`DescriptorStages`.
        desc_fuse2_in_mean: ``(1 + V, H/8, W/8)``.
        desc_raw_norm: ``(1 + V, H/8, W/8)`` length before normalisation.
        descriptors: ``(1 + V, 128, H/8, W/8)``.
        heatmap: ``(H, W)`` of the anchor.
    """

    stem_mean: Tensor
    layer1_mean: Tensor
    layer2_mean: Tensor
    layer3_mean: Tensor
    layer4_mean: Tensor
    det_upsampled_mean: Tensor
    detector_logits: Tensor
    desc_fuse1_in_mean: Tensor
    desc_fuse2_in_mean: Tensor
    desc_raw_norm: Tensor
    descriptors: Tensor
    heatmap: Tensor


class MatchOutputs(NamedTuple):
    """Matching and triangulation of N key points in V sources, P of them shown in detail.

    Attributes:
        project_near: ``(B, V, N, 2)`` pixels at 0.5 m, before any test.
        project_far: ``(B, V, N, 2)`` pixels at 10 m.
        in_range: ``(B, V, N)`` uint8, 1 where the view is used.
        segment_center: ``(B, V, N, 2)`` pixels, zero where dropped.
        segment_length: ``(B, V, N)`` pixels, zero where dropped.
        segment_angle: ``(B, V, N)`` radians.
        probe_grid: ``(B, V, P, 3, 100, 2)`` sample positions, pixels.
        probe_corr: ``(B, V, P, 3, 100)`` correlation.
        probe_corr_act: ``(B, V, P, 3, 100)`` after batch norm and ReLU.
        matches: ``(B, V, N, 2)`` pixels.
        confidence: ``(B, N, 1 + V)`` weights, the anchor first.
        probe_dlt: ``(B * P, 2 + 2V, 4)`` weighted system.
        dlt_singular_values: ``(B * N, 4)`` descending.
        points_3d: ``(B, N, 3)`` in the anchor's camera, metres.
    """

    project_near: Tensor
    project_far: Tensor
    in_range: Tensor
    segment_center: Tensor
    segment_length: Tensor
    segment_angle: Tensor
    probe_grid: Tensor
    probe_corr: Tensor
    probe_corr_act: Tensor
    matches: Tensor
    confidence: Tensor
    probe_dlt: Tensor
    dlt_singular_values: Tensor
    points_3d: Tensor


class DensifyOutputs(NamedTuple):
    """Densification; fields that end in ``_mean`` are means over channels, ``(B, h, w)``.

    Attributes:
        sparse_depth: ``(B, 1, H, W)`` metres, 0 where nothing is known.
        depth_stem_mean: sparse encoder at 1/2.
        depth_layer1_mean: at 1/4.
        depth_layer2_mean: at 1/8.
        depth_layer3_mean: at 1/16.
        depth_layer4_mean: at 1/32.
        up1_mean: first decoder block, at 1/16.
        up2_mean: second, at 1/8.
        pyramid_mean: dilated pyramid, at 1/8.
        up3_mean: third, at 1/4.
        up4_mean: fourth, at 1/2.
        up5_mean: fifth, at full resolution.
        dense_depth: ``(B, 1, H, W)`` metres, unbounded.
        depth_half: ``(B, 1, H/2, W/2)``.
        depth_quarter: ``(B, 1, H/4, W/4)``.
        depth_eighth: ``(B, 1, H/8, W/8)``.
    """

    sparse_depth: Tensor
    depth_stem_mean: Tensor
    depth_layer1_mean: Tensor
    depth_layer2_mean: Tensor
    depth_layer3_mean: Tensor
    depth_layer4_mean: Tensor
    up1_mean: Tensor
    up2_mean: Tensor
    pyramid_mean: Tensor
    up3_mean: Tensor
    up4_mean: Tensor
    up5_mean: Tensor
    dense_depth: Tensor
    depth_half: Tensor
    depth_quarter: Tensor
    depth_eighth: Tensor


class ReferencePrediction(NamedTuple):
    """Depth of one anchor (B = 1), and the key points it rests on.

    Attributes:
        depth: ``(1, 1, H, W)`` metres, unbounded.
        keypoints: ``(1, N, 2)`` pixels of the anchor.
        scores: ``(1, N)`` probabilities, 0 for random points.
        matched: their matches and points.
    """

    depth: Tensor
    keypoints: Tensor
    scores: Tensor
    matched: MatchOutputs


class ReferenceOutputs(NamedTuple):
    """A whole run on one anchor and V sources (B = 1), by the names of its stages.

    Fields are those of :class:`FeatureOutputs`, then of
    :class:`~deltas_nets.reference.keypoints.DetectedKeypoints`, :class:`MatchOutputs` and
    :class:`DensifyOutputs`.
    """

    stem_mean: Tensor
    layer1_mean: Tensor
    layer2_mean: Tensor
    layer3_mean: Tensor
    layer4_mean: Tensor
    det_upsampled_mean: Tensor
    detector_logits: Tensor
    desc_fuse1_in_mean: Tensor
    desc_fuse2_in_mean: Tensor
    desc_raw_norm: Tensor
    descriptors: Tensor
    heatmap: Tensor
    nms_kept: Tensor
    detected_xy: Tensor
    detected_score: Tensor
    project_near: Tensor
    project_far: Tensor
    in_range: Tensor
    segment_center: Tensor
    segment_length: Tensor
    segment_angle: Tensor
    probe_grid: Tensor
    probe_corr: Tensor
    probe_corr_act: Tensor
    matches: Tensor
    confidence: Tensor
    probe_dlt: Tensor
    dlt_singular_values: Tensor
    points_3d: Tensor
    sparse_depth: Tensor
    depth_stem_mean: Tensor
    depth_layer1_mean: Tensor
    depth_layer2_mean: Tensor
    depth_layer3_mean: Tensor
    depth_layer4_mean: Tensor
    up1_mean: Tensor
    up2_mean: Tensor
    pyramid_mean: Tensor
    up3_mean: Tensor
    up4_mean: Tensor
    up5_mean: Tensor
    dense_depth: Tensor
    depth_half: Tensor
    depth_quarter: Tensor
    depth_eighth: Tensor
