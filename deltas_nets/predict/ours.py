"""From posed frames to a depth map."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from deltas_geom import PosedViews
from deltas_nets.captures.capture import Capture, Frame
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.captures.work_size import anchor_views, fit_work_size
from deltas_nets.errors import UserError
from deltas_nets.network.deltas import Deltas, DepthPrediction, with_batch_dims
from deltas_nets.predict import reference as published
from deltas_nets.predict.depth_map import (
    DepthMap,
    KeypointDepths,
    PredictConfig,
    frames_of,
    keypoint_depths,
    point_cloud,
    resized,
)
from deltas_nets.predict.encoded_frames import EncodedFrames
from deltas_nets.reference import ReferenceNetwork

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


def check_asked(
    network: Deltas | ReferenceNetwork,
    config: PredictConfig,
    capture: Capture,
    view_sets: Sequence[ViewSet],
) -> None:
    """Whether a network can do what it is asked for; networks of deltas can do all of it.

    Args:
        network: that is to predict.
        config: sizes, range, confidence.
        capture: the frames.
        view_sets: anchors and sources.

    Raises:
        UserError: the published network, which has one depth range and one camera and states no
            confidence, is asked for others.
    """
    if not isinstance(network, ReferenceNetwork):
        return
    if config.depth_range != published.DEPTH_RANGE:
        near, far = published.DEPTH_RANGE
        raise UserError(
            f"the published network searches {near:g} to {far:g} m", "--depth-range", "leave it out"
        )
    if config.min_confidence > 0:
        raise UserError(
            "the published network states no confidence", "--min-confidence", "leave it out"
        )
    work_size = config.work_size or published.WORK_SIZE
    published.check_work_size(work_size)
    for views in view_sets:
        published.check_cameras(frames_of(capture, views), work_size=work_size)


def states_confidence(network: Deltas | ReferenceNetwork) -> bool:
    """Whether maps of a network come with a confidence."""
    return not isinstance(network, ReferenceNetwork)


def predict_map(
    network: EncodedFrames | ReferenceNetwork, frames: Sequence[Frame], config: PredictConfig
) -> DepthMap:
    """Depth of the first frame from all of them, by a network of either kind.

    Args:
        network: on any device, from :func:`remembering`; asked for what it can do
            (:func:`check_asked`).
        frames: the anchor and its sources.
        config: sizes, range, confidence.

    Raises:
        UserError: an image cannot be read.
    """
    if isinstance(network, ReferenceNetwork):
        return _published_map(network, frames, config)
    result = predict_frame(network, frames, config)
    keypoints = keypoint_depths(result.prediction)
    return DepthMap(result.depth, result.confidence, result.points, result.colors, keypoints)


def _published_map(
    network: ReferenceNetwork, frames: Sequence[Frame], config: PredictConfig
) -> DepthMap:
    work_size = config.work_size or published.WORK_SIZE
    found = published.predict_published(network, frames, work_size=work_size)
    size = config.size or frames[0].image_size
    depth = np.maximum(resized(found.depth, size), 0)  # below 0 it is no depth
    points, colors = point_cloud(frames[0], depth, size, work_size)
    keypoints = KeypointDepths(found.pixels, found.point_depth, work_size)
    return DepthMap(depth, None, points, colors, keypoints)


def remembering(network: Deltas | ReferenceNetwork) -> EncodedFrames | ReferenceNetwork:
    """The network for many view sets of one capture: it encodes every frame once.

    The published network looks at all images of a view set together, so it remembers none.
    """
    return EncodedFrames(network) if isinstance(network, Deltas) else network


@torch.inference_mode()
def predict_frame(
    model: Deltas | EncodedFrames, frames: Sequence[Frame], config: PredictConfig
) -> FrameDepth:
    """Depth of the first frame from all of them.

    Args:
        model: a trained network, on any device; or one that remembers the frames it has seen.
        frames: the anchor and its sources.
        config: sizes, range, confidence.

    Raises:
        UserError: an image cannot be read.
    """
    encode = model if isinstance(model, EncodedFrames) else EncodedFrames(model)
    device = next(encode.model.parameters()).device
    anchor = frames[0]
    work_size = config.work_size or fit_work_size(anchor.image_size, max_pixels=WORK_PIXELS)
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
