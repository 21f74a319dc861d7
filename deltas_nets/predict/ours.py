"""A network of deltas makes a depth map of posed frames."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from deltas_geom import PosedViews
from deltas_nets.captures.capture import Capture, Frame
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.captures.work_size import anchor_views, fit_work_size
from deltas_nets.config import to_dict
from deltas_nets.network.deltas import Deltas, DepthPrediction, with_batch_dims
from deltas_nets.predict.depth_map import (
    DepthMap,
    PredictConfig,
    keypoint_depths,
    point_cloud,
    resized,
)
from deltas_nets.predict.encoded_frames import EncodedFrames
from deltas_nets.weights_file import weights_record

WORK_PIXELS = 120_000
"""Pixels of the image that the network sees, unless a size is given; see decision 5."""


class FrameDepth(NamedTuple):
    """Depth of one frame.

    Attributes:
        depth: ``(H, W)`` float32 metres; 0 where ``min_confidence`` removed it.
        confidence: ``(H, W)`` float32, probability that the relative error is below 5 %.
        points: ``(N, 3)`` float64 in the capture's world, metres.
        colors: ``(N, 3)`` uint8.
        prediction: what the network gave, at the size it works at.
        images: ``(V, 3, h, w)`` the frames as the network saw them.
        views: the cameras, relative to the anchor, at the network's size.
    """

    depth: NDArray[np.float32]
    confidence: NDArray[np.float32]
    points: NDArray[np.float64]
    colors: NDArray[np.uint8]
    prediction: DepthPrediction
    images: torch.Tensor
    views: PosedViews


class DeltasPredictor:
    """A network of deltas for many view sets of one capture: it encodes every frame once.

    See :class:`deltas_nets.predict.predictor.Predictor`.

    Args:
        model: trained, on any device; its weights must not change meanwhile.
    """

    states_confidence = True

    def __init__(self, model: Deltas) -> None:
        self.encode = EncodedFrames(model)

    def check_asked(
        self, config: PredictConfig, capture: Capture, view_sets: Sequence[ViewSet]
    ) -> None:
        """It can do all of it."""

    def depth_map(self, frames: Sequence[Frame], config: PredictConfig) -> DepthMap:
        """Depth of the first frame from all of them."""
        found = predict_frame(self.encode, frames, config)
        prediction = found.prediction
        return DepthMap(
            found.depth,
            found.confidence,
            found.points,
            found.colors,
            keypoint_depths(prediction),
            # In logs, as the network forms it: the order of neighbours stays.
            (prediction.std / prediction.depth).log(),
        )

    def deltas(self, refusal: str, where: str | Path, remedy: str) -> Deltas:
        """The network itself."""
        return self.encode.model

    def network_record(self) -> dict[str, Any]:
        """Its config."""
        return to_dict(self.encode.model.config)

    def weights_record(self, name_or_file: str) -> dict[str, str]:
        """What the weights file says of itself."""
        return weights_record(name_or_file)


@torch.inference_mode()
def predict_frame(
    encode: EncodedFrames, frames: Sequence[Frame], config: PredictConfig
) -> FrameDepth:
    """Depth of the first frame from all of them.

    Args:
        encode: of a trained network, on any device.
        frames: the anchor and its sources.
        config: sizes, range, confidence.

    Raises:
        UserError: an image cannot be read.
    """
    device = next(encode.model.parameters()).device
    anchor = frames[0]
    most = round(WORK_PIXELS * anchor.extent)
    work_size = config.work_size or fit_work_size(anchor.image_size, max_pixels=most)
    images, encoded = encode(frames, work_size=work_size)
    views = anchor_views(frames, work_size=work_size)
    of_one = PosedViews(*(part[None] for part in views.to(device)))
    prediction = with_batch_dims(
        encode.model.from_encoded(encoded, of_one, config.depth_range, image_size=work_size),
        torch.Size(),
    )
    size = config.size or anchor.image_size
    depth = resized(prediction.depth, size)
    confidence = resized(prediction.confidence(), size)
    kept = confidence >= config.min_confidence
    points, colors = point_cloud(anchor, depth * kept, size, work_size)
    return FrameDepth(
        np.where(kept, depth, 0), confidence, points, colors, prediction, images, views
    )
