"""A network of deltas makes a depth map of posed frames."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch

from deltas_geom import PosedViews, rasterize_depth
from deltas_geom.cameras.pixels import resize_pixels
from deltas_nets.captures.capture import Capture, Frame
from deltas_nets.captures.measured import MeasuredDepth
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.captures.work_size import anchor_views, fit_work_size
from deltas_nets.config import to_dict
from deltas_nets.config.varied import NetworkSettings, varied_config
from deltas_nets.errors import UserError
from deltas_nets.network.batch import with_batch_dims
from deltas_nets.network.deltas import Deltas
from deltas_nets.network.known_depth import KnownDepth
from deltas_nets.network.lite.encoder import LiteEncoder
from deltas_nets.network.prediction import DepthPrediction
from deltas_nets.predict.depth_map import (
    WORK_PIXELS,
    DepthMap,
    KeypointDepths,
    PredictConfig,
    Wanted,
    finished_map,
    keypoint_depths,
)
from deltas_nets.predict.described import AtSize, DescribedFrames
from deltas_nets.predict.encoded_frames import EncodedFrames
from deltas_nets.predict.without_points import map_without_points
from deltas_nets.weights_file import weights_record

POINT_PIXELS = 192
"""Pixels of an image for each point of a network with 768: of more pixels there are more points, or
the densifier has too few of them; see decision 26."""


class FrameDepth(NamedTuple):
    """Depth of one frame.

    Attributes:
        map: what is written and scored.
        prediction: what the network gave, at the size it works at.
        images: ``(V, 3, h, w)`` the frames as the network saw them.
        views: the cameras, relative to the anchor, at the network's size.
    """

    map: DepthMap
    prediction: DepthPrediction
    images: torch.Tensor
    views: PosedViews


class DeltasPredictor:
    """A network of deltas for many view sets of one capture: it encodes every frame once.

    See :class:`deltas_nets.predict.predictor.Predictor`.

    Args:
        model: trained, on any device; its weights must not change meanwhile.
        without_points: whether its maps rest on the anchor's image alone.
    """

    states_confidence = True

    @property
    def takes_larger(self) -> bool:
        """If it looks for points, of which a larger image has more."""
        return not self.without_points

    def __init__(self, model: Deltas, *, without_points: bool = False) -> None:
        self.encode = EncodedFrames(model)
        self.describe = DescribedFrames(self.encode)
        self.without_points = without_points

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.encode.model.config.name})"

    def varied(self, settings: NetworkSettings) -> "DeltasPredictor":
        """The same weights in a network of another config."""
        model = self.encode.model
        config = varied_config(model.config, settings)
        with torch.random.fork_rng(devices=()):  # what it starts from is thrown away
            other = Deltas(config).to(next(model.parameters()).device, model.dtype)
        other.load_state_dict(model.state_dict(), assign=True)
        asked = settings.num_points
        without = self.without_points if asked is None else asked == 0
        return DeltasPredictor(other.eval(), without_points=without)

    def check_asked(
        self, config: PredictConfig, capture: Capture, view_sets: Sequence[ViewSet]
    ) -> None:
        """It can do all of it."""

    def check_measured(self) -> None:
        """It takes it."""

    def depth_map(self, wanted: Wanted) -> DepthMap:
        """Depth of the first frame from all of them, and from what was measured."""
        frames, config, measured = wanted
        if len(frames) == 1 or (self.without_points and measured is not None):
            return complete_frame(self.encode, frames[0], config, measured)
        if self.without_points:
            size = work_size_of(frames[0], config)
            return map_without_points(self.encode, frames[0], config, work_size=size)
        return predict_frame(self.encode, frames, config, measured).map

    @torch.inference_mode()
    def redrawn(self, anchor: Frame, agreed: KnownDepth) -> KnownDepth:
        """By the stage that redraws, if the network has one."""
        model = self.encode.model
        if model.redraw is None:
            return agreed
        size = (agreed.depth.shape[-2], agreed.depth.shape[-1])
        _, encoded = self.encode([anchor], work_size=size)
        device = next(model.parameters()).device
        of_one = KnownDepth(*(part[None].to(device) for part in agreed))
        return KnownDepth(*(part[0].cpu() for part in model.redrawn(encoded, of_one)))

    def compared(self, anchor: AtSize, drawn: KnownDepth, around: Sequence[AtSize]) -> KnownDepth:
        """By its descriptors, if they are as fine as those of deltas-small."""
        fine = isinstance(self.encode.model.encoder, LiteEncoder)
        return self.describe.compared(anchor, drawn, around) if fine else drawn

    def deltas(self, refusal: str, where: str | Path, remedy: str) -> Deltas:
        """The network itself."""
        return self.encode.model

    def network_record(self) -> dict[str, Any]:
        """Its config."""
        record = to_dict(self.encode.model.config)
        return record | {"without_points": True} if self.without_points else record

    def weights_record(self, name_or_file: str) -> dict[str, str]:
        """What the weights file says of itself."""
        return weights_record(name_or_file)


@torch.inference_mode()
def predict_frame(
    encode: EncodedFrames,
    frames: Sequence[Frame],
    config: PredictConfig,
    measured: MeasuredDepth | None = None,
) -> FrameDepth:
    """Depth of the first frame from all of them.

    Args:
        encode: of a trained network, on any device.
        frames: the anchor and its sources.
        config: sizes, range, confidence.
        measured: depth of the anchor that joins the triangulated points.

    Raises:
        UserError: an image cannot be read.
    """
    device = next(encode.model.parameters()).device
    anchor = frames[0]
    work_size = work_size_of(anchor, config)
    images, encoded = encode(frames, work_size=work_size)
    views = anchor_views(frames, work_size=work_size)
    of_one = PosedViews(*(part[None] for part in views.to(device)))
    known = None if measured is None else known_depth(anchor, measured, work_size).to(device)
    prediction = with_batch_dims(
        encode.model.from_encoded(
            encoded,
            of_one,
            config.depth_range,
            image_size=work_size,
            num_keypoints=num_points(encode.model, work_size),
            known=known,
        ),
        torch.Size(),
    )
    work = KnownDepth(prediction.depth, prediction.std / prediction.depth)
    found = finished_map(anchor, work, keypoint_depths(prediction), config)
    return FrameDepth(found, prediction, images, views)


@torch.inference_mode()
def complete_frame(
    encode: EncodedFrames, anchor: Frame, config: PredictConfig, measured: MeasuredDepth | None
) -> DepthMap:
    """Depth of a frame from what was measured of it, alone.

    Raises:
        UserError: an image cannot be read, or nothing was measured.
    """
    if measured is None or len(measured.depth) == 0:
        what = f"frame {anchor.id} has no other view and no measured depth"
        raise UserError(what, anchor.image_path, "use --views 2 or more")
    device = next(encode.model.parameters()).device
    work_size = work_size_of(anchor, config)
    _, encoded = encode([anchor], work_size=work_size)
    known = known_depth(anchor, measured, work_size).to(device)
    found = encode.model.complete(encoded, known)
    work = KnownDepth(found.depth[0], (found.std / found.depth)[0])
    keypoints = KeypointDepths.of(known.depth[0])
    return finished_map(anchor, work, keypoints, config)


def work_size_of(anchor: Frame, config: PredictConfig) -> tuple[int, int]:
    """(height, width) that the network sees."""
    if config.work_size is not None:
        return config.work_size
    height, width = anchor.image_size
    # Places are found to a part of what the network sees as a pixel.
    enlarged = config.enlarged if height * width < WORK_PIXELS * anchor.extent else 1.0
    most = round(config.work_pixels * anchor.extent)
    return fit_work_size(anchor.image_size, max_pixels=most, enlarged=enlarged)


def num_points(model: Deltas, work_size: tuple[int, int]) -> int:
    """How many points are looked for in an image of (height, width): the config's, or more."""
    usual: int = model.config.detector.num_keypoints
    return max(usual, round(usual * work_size[0] * work_size[1] / (POINT_PIXELS * 768)))


def known_depth(anchor: Frame, measured: MeasuredDepth, work_size: tuple[int, int]) -> KnownDepth:
    """Measured depth as images ``(1, 1, *work_size)``; where two share a pixel, the nearer."""
    pixels = torch.from_numpy(measured.pixels)
    pixels = resize_pixels(pixels, old_size=anchor.image_size, new_size=work_size)
    depth = torch.from_numpy(measured.depth)
    drawn = rasterize_depth(pixels, depth, image_size=work_size).depth.float()[None]
    return KnownDepth(drawn, torch.full_like(drawn, measured.deviation))
