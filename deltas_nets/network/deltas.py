"""DELTAS: the method whole. Start reading here."""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from deltas_geom import PosedViews, SparseDepth, rasterize_depth, triangulate
from deltas_geom.checks import check_kind
from deltas_geom.numerics.arithmetic import outside_autocast
from deltas_nets.config import NetworkConfig
from deltas_nets.network.batch import flat_batch, with_batch_dims
from deltas_nets.network.build import build_stages
from deltas_nets.network.encoded import Encoded
from deltas_nets.network.image_range import check_images
from deltas_nets.network.known_depth import KnownDepth, as_points, reconciled
from deltas_nets.network.layers import upsample_to
from deltas_nets.network.lite.calibration import SpreadCalibration
from deltas_nets.network.lite.densifier import DenseDepth
from deltas_nets.network.origin import moved_to_anchor
from deltas_nets.network.prediction import DepthPrediction, Evidence


class Densified(NamedTuple):
    """What the last stage says.

    Attributes:
        dense: at all scales.
        depth: ``(B, 1, H, W)`` metres along z.
        std: ``(B, 1, H, W)`` its standard deviation, metres, calibrated if the weights are.
    """

    dense: DenseDepth
    depth: Tensor
    std: Tensor


class Deltas(nn.Module):
    """Posed images in, metric depth of the first one out.

    Args:
        config: sizes and choices; `NetworkConfig()` has those of `deltas-small`.

    Raises:
        TypeError: not a config.

    Example:
        >>> model = Deltas(NetworkConfig()).eval()
        >>> K = torch.tensor([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]]).expand(2, 3, 3)
        >>> pose = torch.eye(4).repeat(2, 1, 1)
        >>> pose[1, 0, 3] = -0.2
        >>> with torch.no_grad():
        ...     prediction = model(torch.rand(2, 3, 48, 64), PosedViews(K, pose))
        >>> prediction.depth.shape
        torch.Size([1, 48, 64])
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        check_kind("config", config, NetworkConfig, "load_model(NAME) for weights of a name")
        self.config = config
        stages = build_stages(config)
        self.encoder = stages.encoder
        self.detector = stages.detector
        self.descriptor = stages.descriptor
        self.matcher = stages.matcher
        self.judge = stages.judge
        self.densifier = stages.densifier
        self.redraw = stages.redraw

    @property
    def dtype(self) -> torch.dtype:
        """The dtype of the weights: images are cast to it, and cameras, but to float32 at least."""
        return next(self.parameters()).dtype

    @property
    def calibration(self) -> SpreadCalibration:
        """What makes the standard deviation of the dense map true."""
        return self.densifier.calibration

    def forward(
        self,
        images: Tensor,
        views: PosedViews,
        depth_range: tuple[float, float] = (0.5, 10.0),
        *,
        num_keypoints: int | None = None,
        shift: Tensor | None = None,
        refinement: int | None = None,
        known: KnownDepth | None = None,
    ) -> DepthPrediction:
        """Predict the depth of view 0.

        Args:
            images: ``(*B, V, 3, H, W)`` RGB in [0, 1]; view 0 is the anchor, V >= 2. Of any
                floating dtype, as are the cameras: both are cast to that of the weights.
            views: their cameras, ``(*B, V)``, anywhere in the world: they are moved to
                its origin before they are cast.
            depth_range: (near, far) of the search, metres.
            num_keypoints: instead of the config's.
            shift: ``(*B, 2)`` moves the spread keypoints, for variety in training.
            refinement: room for this many samples in each bin of inverse depth, whatever the
                cameras, where shapes must not follow from values. Without it there are as many as
                the widest view needs.
            known: ``(*B, 1, H, W)`` depth of view 0 that joins the triangulated points.

        Raises:
            ShapeError: a trailing shape differs, there is no source, or the batch is empty.
            ValueError: the depth range makes no sense, the refinement is not positive, or, where
                values can be looked at (on the CPU, untraced), the images are not in [0, 1].
            TypeError: the images are integers.
        """
        flat = flat_batch(images, views, depth_range)
        if refinement is not None and refinement < 1:
            raise ValueError(f"refinement must be at least 1, got {refinement}")
        prediction = self.from_encoded(
            self.encode(flat.images),
            flat.views,
            depth_range,
            image_size=flat.image_size,
            num_keypoints=num_keypoints,
            shift=None if shift is None else shift.reshape(-1, 2),
            refinement=refinement,
            known=None if known is None else _flat_maps(known),
        )
        return with_batch_dims(prediction, flat.dims)

    def encode(self, images: Tensor) -> Encoded:
        """The part that knows one image at a time: of a video, once per frame is enough.

        Args:
            images: ``(B, V, 3, H, W)`` RGB in [0, 1].

        Raises:
            TypeError, ValueError: they are not, as for :meth:`forward`.
        """
        check_images(images)
        features = self.encoder(images.to(self.dtype))
        return Encoded(features, self.descriptor(features))

    def from_encoded(
        self,
        encoded: Encoded,
        views: PosedViews,
        depth_range: tuple[float, float] = (0.5, 10.0),
        *,
        image_size: tuple[int, int],
        num_keypoints: int | None = None,
        shift: Tensor | None = None,
        refinement: int | None = None,
        known: KnownDepth | None = None,
    ) -> DepthPrediction:
        """Predict the depth of view 0 of encoded images.

        Args:
            encoded: from :meth:`encode`, of B x V images.
            views: their cameras, ``(B, V)``.
            depth_range: (near, far) of the search, metres.
            image_size: (height, width) of the images.
            num_keypoints: instead of the config's.
            shift: ``(B, 2)`` as for :meth:`forward`.
            refinement: as for :meth:`forward`.
            known: ``(B, 1, H, W)`` as for :meth:`forward`.
        """
        features, descriptors = encoded
        views, origin = moved_to_anchor(views, torch.promote_types(self.dtype, torch.float32))
        keypoints = self.detector(
            features, image_size=image_size, num_keypoints=num_keypoints, shift=shift
        )
        # Geometry keeps full precision whatever the network around it runs in.
        with outside_autocast(views.K.device.type):
            matched = self.matcher(
                keypoints.pixels,
                descriptors,
                views,
                image_size=image_size,
                depth_range=depth_range,
                refinement=refinement,
            )
            matches, posterior, confidence = matched.matches, matched.posterior, matched.confidence
            points = triangulate(views.proj, matches.pixels, matches.weights, matches.mask)
            if self.judge is not None and matched.chosen is not None:
                confidence = self.judge(matched.chosen, matches, posterior, points, views)
            # A point may leave the range that was searched, as matches move afterwards; not by far.
            points = points.within_depth((0.5 * depth_range[0], 2 * depth_range[1]))
            sparse = rasterize_depth(
                keypoints.pixels,
                points.depth[:, 0],
                image_size=image_size,
                mask=points.valid,
                weights=confidence,
                reduce="mean",
            )
        dense, depth, std = self.densified(encoded, sparse, num_views=views.K.shape[1])
        if known is not None:
            sparse = reconciled(sparse, known, dense.log_depth[0])
            dense, depth, std = self.densified(encoded, sparse, num_views=views.K.shape[1])
        in_world = torch.where(points.valid[..., None], points.points + origin, 0.0)
        return DepthPrediction(
            depth=depth,
            std=std,
            keypoints=keypoints,
            matches=matches,
            points=points._replace(points=in_world),
            sparse=sparse,
            evidence=Evidence(confidence, posterior, dense),
        )

    def densified(self, encoded: Encoded, sparse: SparseDepth, *, num_views: int) -> Densified:
        """The last stage alone: a map of whatever sparse depth there is.

        Args:
            encoded: the anchor, or a view set whose first view it is, of B images.
            sparse: ``(B, 1, H, W)`` its points.
            num_views: how many views these come from, for the standard deviation.
        """
        dense = self.densifier(encoded.features, sparse)
        depth = dense.log_depth[0].exp()
        size = (sparse.depth.shape[-2], sparse.depth.shape[-1])
        log_std = upsample_to(_log_deviation(dense), size)
        return Densified(dense, depth, self.calibration(log_std, num_views).exp() * depth)

    def redrawn(self, encoded: Encoded, agreed: KnownDepth) -> KnownDepth:
        """A map that several frames agreed on, with the edges that the image shows.

        Its deviation is the geometric mean of what the frames state, which tells better where a map
        is sure, and of what the stage has learned, which tells better how sure.

        Without a stage that redraws, as in networks of which `deltas redraw` trained none, it stays
        as it is.

        Args:
            encoded: the anchor, or a view set whose first view it is, of B images.
            agreed: ``(B, 1, H, W)``.
        """
        if self.redraw is None:
            return agreed
        drawn = self.redraw(encoded.features, agreed)
        learned = _log_deviation(drawn).exp()
        both = torch.where(agreed.depth > 0, (agreed.deviation * learned).sqrt(), learned)
        return KnownDepth(drawn.log_depth[0].exp(), both)

    def complete(self, encoded: Encoded, known: KnownDepth) -> Densified:
        """A map of one image and depth that is known of it; no other view is looked at.

        Args:
            encoded: of B images.
            known: ``(B, 1, H, W)``.
        """
        # The standard deviation is that of two views: there is no curve for one.
        first = self.densified(encoded, as_points(known), num_views=2)
        nothing = SparseDepth(*(torch.zeros_like(part) for part in known))
        believed = reconciled(nothing, known, first.dense.log_depth[0])
        return self.densified(encoded, believed, num_views=2)


def _log_deviation(dense: DenseDepth) -> Tensor:
    """Of the log of depth, at the resolution of its spread, before calibration."""
    # A Laplace distribution deviates by sqrt(2) of its scale.
    return dense.log_spread + 0.5 * math.log(2)


def _flat_maps(known: KnownDepth) -> KnownDepth:
    return KnownDepth(*(part.reshape(-1, *part.shape[-3:]) for part in known))
