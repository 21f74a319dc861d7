"""The reference network: the layers of `deltas_nets.network` under its own rules."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from deltas_geom import PosedViews
from deltas_geom.cameras.poses import relative_pose
from deltas_geom.checks import ShapeError
from deltas_nets.config.varied import NetworkSettings
from deltas_nets.network.lite.detector import CELL
from deltas_nets.network.paper.resnet import ResNet50
from deltas_nets.network.paper.sparse_densifier import (
    DecoderMaps,
    DepthScales,
    SparseDensifier,
    join_taps,
)
from deltas_nets.network.paper.superpoint_head import DescriptorHead, DetectorHead
from deltas_nets.network.paper.taps import Taps, imagenet_normalised
from deltas_nets.reference.enlarge import enlarge_by_rows
from deltas_nets.reference.features import heatmap_of, shown_features
from deltas_nets.reference.keypoints import DetectedKeypoints, pick_keypoints
from deltas_nets.reference.matched import matched_points
from deltas_nets.reference.outputs import (
    DensifyOutputs,
    MatchOutputs,
    ReferenceFeatures,
    ReferenceOutputs,
    ReferencePrediction,
)
from deltas_nets.reference.points import draw_sparse_depth
from deltas_nets.reference.precision import full_precision
from deltas_nets.reference.scores import MatchNorm
from deltas_nets.reference.settings import PUBLISHED, choose_keypoints

Indices = Tensor | Sequence[int]


class ReferenceNetwork(nn.Module):
    """Runs a published checkpoint; made by :func:`deltas_nets.reference.load`.

    Everything is float32, without TF32, in evaluation mode and without gradients. Images are a
    whole number of 8x8 cells in height and width: with others the original could not run. All
    methods take tensors on the network's device.
    """

    side_multiple = CELL
    """Height and width of images are multiples of it."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = ResNet50(inputs=3, width=64)
        self.detector_head = DetectorHead(self.encoder.channels)
        self.descriptor_head = DescriptorHead(self.encoder.channels)
        self.match_norm = MatchNorm()
        self.densifier = SparseDensifier(
            ResNet50(inputs=1, width=16), self.encoder.channels, enlarge=enlarge_by_rows
        )

    @torch.no_grad()
    def features(self, images: Tensor) -> ReferenceFeatures:
        """Taps, detector and descriptors of all images.

        Args:
            images: ``((1 + V) * B, 3, H, W)`` RGB at network level, first the B anchors, then
                their first sources and so on. In [0, 1], or as
                :func:`~deltas_nets.reference.evaluation_input` gives them: the network normalises
                by ImageNet's mean and deviation either way.

        Raises:
            ShapeError: the shape differs, or H or W is no multiple of 8.
        """
        if images.ndim != 4 or images.shape[1] != 3:
            raise ShapeError(f"images must have shape (B, 3, H, W), got {tuple(images.shape)}")
        size = (images.shape[-2], images.shape[-1])
        if size[0] % CELL or size[1] % CELL or not min(size):
            raise ShapeError(f"images must have H and W that are multiples of {CELL}, got {size}")
        with full_precision(images.device):
            taps: Taps = self.encoder(imagenet_normalised(images))
            return ReferenceFeatures(
                taps,
                self.detector_head(taps, image_size=size),
                self.descriptor_head(taps, image_size=size),
            )

    @torch.no_grad()
    def pick(
        self,
        logits: Tensor,
        *,
        num_points: int = 512,
        radius: int = 9,
        threshold: float = 0.0005,
        fraction: float = 0.5,
    ) -> DetectedKeypoints:
        """Detected key points of one image, for example the anchor.

        Args:
            logits: ``(65, h, w)`` of the image.
            num_points: key points wanted in all.
            radius: of the suppression, pixels.
            threshold: only scores strictly above it are picked.
            fraction: at most this share of ``num_points`` is detected.
        """
        return pick_keypoints(
            heatmap_of(logits),
            num_points=num_points,
            radius=radius,
            threshold=threshold,
            fraction=fraction,
        )

    @torch.no_grad()
    def match(
        self,
        descriptors: Tensor,
        keypoints: Tensor,
        intrinsics: Tensor,
        cam_from_anchor: Tensor,
        *,
        probe_points: Indices = (),
        settings: NetworkSettings = PUBLISHED,
    ) -> MatchOutputs:
        """Match and triangulate the anchors' key points.

        Args:
            descriptors: ``((1 + V) * B, 128, h, w)`` of unit length, in the order of
                :meth:`features`; the images are 8h x 8w.
            keypoints: ``(B, N, 2)`` pixels of the anchors.
            intrinsics: ``(B, 3, 3)``, the same for all views.
            cam_from_anchor: ``(B, V, 4, 4)`` of the sources, metres.
            probe_points: P indices of key points to show in detail.
            settings: of the samples; what is not given is as in :data:`PUBLISHED`.

        Raises:
            ShapeError: a shape differs.
        """
        probe = torch.as_tensor(probe_points, dtype=torch.long, device=keypoints.device)
        return matched_points(
            self.match_norm,
            descriptors,
            keypoints,
            intrinsics,
            cam_from_anchor,
            probe=probe,
            settings=settings,
        )

    @torch.no_grad()
    def densify(
        self, anchor_taps: Taps, keypoints: Tensor, points_3d: Tensor, in_range: Tensor
    ) -> DensifyOutputs:
        """Dense depth of the anchors.

        Args:
            anchor_taps: of the B anchors alone, ``features.taps.of_first(B)``.
            keypoints: ``(B, N, 2)`` pixels.
            points_3d: ``(B, N, 3)`` in the anchors' cameras, metres.
            in_range: ``(B, V, N)``, 1 where a source has the point in range.

        Raises:
            ShapeError: the taps are of another number of images than the key points.
        """
        if len(anchor_taps.eighth) != len(keypoints):
            raise ShapeError(
                f"anchor_taps are of {len(anchor_taps.eighth)} images but keypoints of "
                f"{len(keypoints)}; take features.taps.of_first({len(keypoints)})"
            )
        size = (CELL * anchor_taps.eighth.shape[-2], CELL * anchor_taps.eighth.shape[-1])
        seen = (in_range != 0).any(dim=1)
        sparse = draw_sparse_depth(keypoints, points_3d, seen, image_size=size)
        with full_precision(keypoints.device):
            depth_taps: Taps = self.densifier.encoder(sparse)
            maps: DecoderMaps = self.densifier.decoder(
                join_taps(anchor_taps, depth_taps), image_size=size
            )
            scales: DepthScales = self.densifier.decoder.depths(maps)
        encoder_means = Taps(*(tap.mean(dim=1) for tap in depth_taps))
        decoder_means = DecoderMaps(*(feature.mean(dim=1) for feature in maps))
        return DensifyOutputs(sparse, *encoder_means, *decoder_means, *scales)

    @torch.no_grad()
    def run(
        self,
        images: Tensor,
        keypoints: Tensor,
        intrinsics: Tensor,
        cam_from_anchor: Tensor,
        *,
        probe_points: Indices | None = None,
        num_points: int = 512,
        radius: int = 9,
        threshold: float = 0.0005,
    ) -> ReferenceOutputs:
        """Everything from one anchor and its sources, with given key points.

        Args:
            images: ``(1 + V, 3, H, W)`` as for :meth:`features`.
            keypoints: ``(1, N, 2)`` pixels of the anchor. What the detector finds is among the
                outputs, and is not used.
            intrinsics: ``(1, 3, 3)``, the same for all views.
            cam_from_anchor: ``(1, V, 4, 4)`` of the sources, metres.
            probe_points: P indices of key points to show in detail.
            num_points, radius, threshold: for the detected key points, see :meth:`pick`.

        Raises:
            ShapeError: a shape differs, or there is more than one anchor.
        """
        if len(keypoints) != 1:
            raise ShapeError(f"keypoints must have shape (1, N, 2), got {tuple(keypoints.shape)}")
        features = self.features(images)
        detected = self.pick(
            features.detector.logits[0], num_points=num_points, radius=radius, threshold=threshold
        )
        matched = self.match(
            features.descriptor.unit,
            keypoints,
            intrinsics,
            cam_from_anchor,
            probe_points=() if probe_points is None else probe_points,
        )
        densified = self.densify(
            features.taps.of_first(1), keypoints, matched.points_3d, matched.in_range
        )
        return ReferenceOutputs(*shown_features(features), *detected, *matched, *densified)

    def forward(
        self, images: Tensor, views: PosedViews, *, num_keypoints: int = 512
    ) -> ReferencePrediction:
        """Do as :meth:`predict`, called as networks of deltas are; random points never change.

        Args:
            images: as for :meth:`predict`.
            views: ``(1 + V)``; the anchor's K is that of all.
            num_keypoints: key points in all.
        """
        poses = views.cam_from_world
        return self.predict(
            images,
            views.K[:1],
            relative_pose(poses[1:], poses[:1])[None],
            settings=NetworkSettings(num_points=num_keypoints),
            generator=torch.Generator().manual_seed(0),
        )

    @torch.no_grad()
    def predict(
        self,
        images: Tensor,
        intrinsics: Tensor,
        cam_from_anchor: Tensor,
        *,
        settings: NetworkSettings = PUBLISHED,
        generator: torch.Generator | None = None,
    ) -> ReferencePrediction:
        """Depth of one anchor, with key points as the original picks them.

        Args:
            images: ``(1 + V, 3, H, W)`` as for :meth:`features`; published weights were trained
                with what :func:`~deltas_nets.reference.evaluation_input` gives.
            intrinsics: ``(1, 3, 3)``, the same for all views.
            cam_from_anchor: ``(1, V, 4, 4)`` of the sources, metres.
            settings: what is not given is as in :data:`PUBLISHED`.
            generator: of the random ones; on the CPU, whatever the device of the images.

        Raises:
            ShapeError: a shape differs, or there is more than one anchor.
        """
        features = self.features(images)
        heatmap = heatmap_of(features.detector.logits[0])
        xy, score = choose_keypoints(heatmap, settings, generator=generator)
        matched = self.match(
            features.descriptor.unit, xy[None], intrinsics, cam_from_anchor, settings=settings
        )
        densified = self.densify(
            features.taps.of_first(1), xy[None], matched.points_3d, matched.in_range
        )
        return ReferencePrediction(densified.dense_depth, xy[None], score[None], matched)
