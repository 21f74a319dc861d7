"""From posed frames to a depth map."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from deltas_geom import PosedViews, unproject
from deltas_nets import published
from deltas_nets.data.capture import Capture, Frame
from deltas_nets.data.sample import anchor_views, fit_work_size, resize_image
from deltas_nets.data.view_sets import ViewSet
from deltas_nets.encoded_frames import EncodedFrames
from deltas_nets.errors import UserError
from deltas_nets.network.deltas import Deltas, DepthPrediction, with_batch_dims
from deltas_nets.reference import ReferenceNetwork

WORK_PIXELS = 120_000
"""Pixels of the image that the network sees, unless a size is given; see decision 5."""


@dataclass(frozen=True)
class PredictConfig:
    """What a depth map depends on besides its frames and the weights."""

    depth_range: tuple[float, float] = (0.5, 10.0)
    """Nearest and farthest depth searched, metres."""
    work_size: tuple[int, int] | None = None
    """(height, width) that the network sees; chosen to suit it if not given."""
    size: tuple[int, int] | None = None
    """(height, width) of the maps; the colour image's own if not given."""
    min_confidence: float = 0.0
    """Pixels of less confidence (0 to 1) are left out; 0 keeps every pixel."""

    def __post_init__(self) -> None:
        near, far = self.depth_range
        if not 0 < near < far:
            raise ValueError(
                f"--depth-range must be NEAR FAR with 0 < NEAR < FAR, got {near} {far}"
            )
        for name, size in (("--work-size", self.work_size), ("--size", self.size)):
            if size is not None and min(size) < 32:
                raise ValueError(f"{name} must be HEIGHT WIDTH of 32 or more, got {size}")
        if not 0 <= self.min_confidence <= 1:
            raise ValueError(f"--min-confidence must be within 0 to 1, got {self.min_confidence}")


class FrameDepth(NamedTuple):
    """Depth of one frame.

    Attributes:
        depth: ``(H, W)`` float32 metres; 0 where ``min_confidence`` removed it.
        confidence: ``(H, W)`` float32, probability that the relative error is below 5 %.
        points: ``(N, 3)`` in the capture's world, metres.
        colors: ``(N, 3)`` uint8.
        prediction: what the network gave, at the size it works at.
        images: ``(V, 3, h, w)`` the frames as the network saw them.
        views: the cameras, relative to the anchor, at the network's size.
    """

    depth: NDArray[np.float32]
    confidence: NDArray[np.float32]
    points: NDArray[np.float32]
    colors: NDArray[np.uint8]
    prediction: DepthPrediction
    images: torch.Tensor
    views: PosedViews


class KeypointDepths(NamedTuple):
    """Triangulated depth of an anchor's keypoints.

    Attributes:
        pixels: ``(N, 2)`` at the size that the network works at.
        depth: ``(N,)`` metres, 0 where there is none.
        image_size: (height, width) of that size.
    """

    pixels: torch.Tensor
    depth: torch.Tensor
    image_size: tuple[int, int]


class DepthMap(NamedTuple):
    """What any network says of a frame: what is written and scored.

    Attributes:
        depth: ``(H, W)`` float32 metres; 0 where there is none.
        confidence: ``(H, W)`` float32 as in `FrameDepth`; None where the network states none.
        points: ``(N, 3)`` in the capture's world, metres.
        colors: ``(N, 3)`` uint8.
        keypoints: the points that the map rests on.
    """

    depth: NDArray[np.float32]
    confidence: NDArray[np.float32] | None
    points: NDArray[np.float32]
    colors: NDArray[np.uint8]
    keypoints: KeypointDepths


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


def keypoint_depths(prediction: DepthPrediction) -> KeypointDepths:
    """The triangulated points of a prediction without batch dims."""
    return KeypointDepths(
        prediction.keypoints.pixels,
        prediction.points.depth[0],
        (prediction.depth.shape[-2], prediction.depth.shape[-1]),
    )


def _published_map(
    network: ReferenceNetwork, frames: Sequence[Frame], config: PredictConfig
) -> DepthMap:
    work_size = config.work_size or published.WORK_SIZE
    found = published.predict_published(network, frames, work_size=work_size)
    size = config.size or frames[0].image_size
    depth = np.maximum(_resized(found.depth, size), 0)  # below 0 it is no depth
    points, colors = _point_cloud(frames[0], depth, size, work_size)
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
    depth = _resized(prediction.depth, size)
    confidence = _resized(prediction.confidence(), size)
    kept = confidence >= config.min_confidence
    points, colors = _point_cloud(anchor, depth * kept, size, work_size)
    return FrameDepth(
        np.where(kept, depth, 0), confidence, points, colors, prediction, images, views
    )


def _resized(image: torch.Tensor, size: tuple[int, int]) -> NDArray[np.float32]:
    resized = F.interpolate(image[None], size=size, mode="bilinear", align_corners=False)
    array: NDArray[np.float32] = resized[0, 0].float().cpu().numpy()
    return array


def _point_cloud(
    anchor: Frame, depth: NDArray[np.float32], size: tuple[int, int], work_size: tuple[int, int]
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """World points of the map, about as many as the network has pixels, with their colours."""
    step = max(1, round(size[0] / work_size[0]))
    rows, columns = np.mgrid[step // 2 : size[0] : step, step // 2 : size[1] : step].reshape(2, -1)
    z = torch.from_numpy(depth[rows, columns]).double()
    view = PosedViews(
        torch.tensor(anchor.K)[None], torch.tensor(anchor.cam_from_world)[None]
    ).resize(old_size=anchor.image_size, new_size=size)
    pixels = torch.from_numpy(np.stack([columns, rows], axis=-1)).double()
    points = unproject(view, pixels[None], z[None])[0]
    colors = resize_image(anchor.read_image(), size)[rows, columns]
    known = z.numpy() > 0
    return points.numpy()[known].astype(np.float32), colors[known]


def frames_of(capture: Capture, views: ViewSet) -> list[Frame]:
    """The anchor, then its sources."""
    return [capture.frame(id) for id in (views.anchor, *views.sources)]
