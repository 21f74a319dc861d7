"""A cost-volume network of MVDepthNet's kind, with the encoder and the fine end of `deltas-small`.

Where DELTAS triangulates some hundred points and densifies them, it compares every pixel with the
sources at every one of S inverse depths and lets 2D convolutions decide. It is here to be trained
by the same code, on the same rooms, for as many steps, and measured beside ours.

Source: Wang and Shen, MVDepthNet: real-time multiview depth estimation neural network (2018). Its
volume is of colours at full resolution and its decoder has 33 million weights; ours is of learned
features at a quarter, and its widths are such that it takes as many multiply-accumulates as
`deltas-small` at 144 x 192 (`benchmarks/cost_volume.py`).
"""

import math

import torch
from torch import Tensor, nn

from deltas_geom import Matches, PosedViews, SparseDepth, Triangulation
from deltas_geom.numerics.arithmetic import outside_autocast
from deltas_nets.config import NetworkConfig
from deltas_nets.config.encoders import ENCODERS
from deltas_nets.config.lookup import look_up
from deltas_nets.network.batch import flat_batch, with_batch_dims
from deltas_nets.network.cost_volume.decoder import Planes, VolumeDecoder
from deltas_nets.network.cost_volume.volume import difference_volume
from deltas_nets.network.image_range import check_images
from deltas_nets.network.joint.inverse_depths import bin_centres
from deltas_nets.network.lite.calibration import SpreadCalibration
from deltas_nets.network.lite.densifier import DenseDepth
from deltas_nets.network.lite.detector import CELL, Keypoints
from deltas_nets.network.origin import moved_to_anchor
from deltas_nets.network.prediction import DepthPrediction, Evidence
from deltas_nets.network.records import Posterior

WIDTH = 16
"""Channels of the features that are compared."""


class CostVolume(nn.Module):
    """Posed images in, metric depth of the first one out, without points.

    Args:
        config: of ``matcher.kind`` "volume"; ``matcher.num_samples`` is the number of planes.

    Example:
        >>> from deltas_nets.config import CONFIGS
        >>> model = CostVolume(CONFIGS["cost-volume"]).eval()
        >>> K = torch.tensor([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]]).expand(2, 3, 3)
        >>> pose = torch.eye(4).repeat(2, 1, 1)
        >>> pose[1, 0, 3] = -0.2
        >>> with torch.no_grad():
        ...     prediction = model(torch.rand(2, 3, 48, 64), PosedViews(K, pose))
        >>> prediction.depth.shape, prediction.keypoints.pixels.shape
        (torch.Size([1, 48, 64]), torch.Size([0, 2]))
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.encoder = look_up("deltas_nets.network", ENCODERS[config.backbone].place).whole()
        channels, planes = self.encoder.channels, config.matcher.num_samples
        half, quarter, eighth, sixteenth = config.densifier_widths
        self.compared = nn.Conv2d(channels.quarter, WIDTH, 3, padding=1)
        self.decoder = VolumeDecoder((half, quarter, eighth, sixteenth), channels, planes)

    @property
    def dtype(self) -> torch.dtype:
        """The dtype of the weights."""
        return next(self.parameters()).dtype

    @property
    def calibration(self) -> SpreadCalibration:
        """What makes the standard deviation of the dense map true."""
        return self.decoder.calibration

    def forward(
        self,
        images: Tensor,
        views: PosedViews,
        depth_range: tuple[float, float] = (0.5, 10.0),
        *,
        num_keypoints: int | None = None,
        shift: Tensor | None = None,
    ) -> DepthPrediction:
        """Predict the depth of view 0; the prediction has no points.

        Args:
            images: ``(*B, V, 3, H, W)`` RGB in [0, 1]; view 0 is the anchor, V >= 2.
            views: their cameras, ``(*B, V)``, anywhere in the world.
            depth_range: (near, far) of the planes, metres.
            num_keypoints: of networks with points.
            shift: likewise.

        Raises:
            ShapeError: a trailing shape differs, there is no source, or the batch is empty.
            ValueError: the depth range makes no sense, or the images are not in [0, 1].
        """
        images, views, batch = flat = flat_batch(images, views, depth_range)
        size = flat.image_size
        check_images(images)
        features = self.encoder(images.to(self.dtype))
        compared = self.compared(features.quarter.flatten(0, 1)).unflatten(0, images.shape[:2])
        near_origin, _ = moved_to_anchor(views, torch.promote_types(self.dtype, torch.float32))
        inv_depths = bin_centres(self.config.matcher.num_samples, depth_range, like=near_origin.K)
        # Geometry keeps full precision whatever the network around it runs in.
        with outside_autocast(images.device.type):
            difference = difference_volume(compared, near_origin, inv_depths, image_size=size)
        dense = self.decoder(features.of_anchor(), Planes(difference, inv_depths), size)
        depth = dense.log_depth[0].exp()
        # A Laplace distribution deviates by sqrt(2) of its scale.
        log_std = self.calibration(dense.log_spread + 0.5 * math.log(2), images.shape[1])
        prediction = without_points(dense, depth, log_std.exp() * depth, near_origin, inv_depths)
        return with_batch_dims(prediction, batch)


def without_points(
    dense: DenseDepth, depth: Tensor, std: Tensor, views: PosedViews, inv_depths: Tensor
) -> DepthPrediction:
    """A prediction of no keypoints, so that what reads predictions reads this one too.

    Args:
        dense: at all scales.
        depth: ``(B, 1, H, W)`` metres.
        std: ``(B, 1, H, W)`` metres.
        views: ``(B, V)``.
        inv_depths: ``(S,)`` of the planes, 1/m.
    """
    count, num_views, (height, width) = *views.K.shape[:2], depth.shape[-2:]
    empty = views.K.new_zeros(count, num_views, 0)
    none = torch.zeros_like(empty, dtype=torch.bool)
    of_one = empty[:, 0]
    cells = (math.ceil(height / CELL), math.ceil(width / CELL))
    logits = depth.new_zeros(count, CELL * CELL + 1, *cells)
    return DepthPrediction(
        depth=depth,
        std=std,
        keypoints=Keypoints(empty.new_zeros(count, 0, 2), of_one, logits),
        matches=Matches(
            pixels=empty.new_zeros(count, num_views, 0, 2),
            weights=empty,
            covariance=empty.new_zeros(count, num_views, 0, 2, 2),
            mask=none,
        ),
        points=Triangulation(
            points=empty.new_zeros(count, 0, 3),
            depth=empty,
            status=of_one.to(torch.int8),
            valid=none[:, 0],
            residual=of_one,
            parallax=of_one,
            covariance=None,
            errors=empty,
        ),
        sparse=SparseDepth(torch.zeros_like(depth), torch.zeros_like(depth)),
        evidence=Evidence(
            of_one,
            Posterior(
                (empty.new_zeros(count, 1, 0, len(inv_depths)),),
                inv_depths,
                torch.zeros(count, 1, 0, len(inv_depths), dtype=torch.bool, device=depth.device),
            ),
            dense,
        ),
    )
