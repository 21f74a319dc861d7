"""What a network makes of frames as they are: in any unit, through any lens."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from deltas_nets.captures.frame import FloatArray, Frame
from deltas_nets.captures.measured import MeasuredDepth
from deltas_nets.captures.scaled import moved_frame
from deltas_nets.captures.straight import (
    StraightFrame,
    in_photo,
    photo_pixels,
    pixels_of_photo,
    straight,
)
from deltas_nets.predict.depth_map import DepthMap, PredictConfig, Wanted, resized
from deltas_nets.predict.measured_factor import measured_factor
from deltas_nets.predict.predictor import Predictor
from deltas_nets.predict.reach import Reach

__all__ = ["as_photographed", "found_depths", "look"]


def look(
    predictor: Predictor,
    frames: Sequence[Frame],
    config: PredictConfig,
    reach: Reach,
    measured: MeasuredDepth | None = None,
) -> DepthMap:
    """Depth of the first frame, as its photo shows it, in the capture's unit.

    Args:
        predictor: of a trained network.
        frames: the anchor and its sources.
        config: all but the range.
        reach: what is searched.
        measured: what is known of the anchor, in the capture's unit.

    Raises:
        UserError: an image cannot be read.
        TypeError: no `Predictor`, or one that gives something else than a map of the size that was
            asked for.
    """
    if not hasattr(predictor, "depth_map"):
        given = type(predictor).__name__
        raise TypeError(f"network must be a Predictor, got {given}: use load_predictor(NAME)")
    unit = reach.unit
    config = replace(config, depth_range=(reach.near * unit, reach.far * unit))
    anchor, *others = map(straight, frames)
    seen = [moved_frame(frame, unit) for frame in (anchor, *others)]
    if measured is not None:
        measured = measured._replace(depth=measured.depth * unit)
    of_straight = replace(config, size=None) if isinstance(anchor, StraightFrame) else config
    wanted = Wanted(seen, of_straight, measured)
    found = predictor.depth_map(wanted)
    _check_map(found, wanted.size, who=type(predictor).__name__)
    if measured is not None and others:
        factor = measured_factor(found.keypoints, measured, anchor.image_size)
        found = found._replace(measured_factor=factor)
    found = found if unit == 1 else _in_units_of_capture(found, unit)
    return as_photographed(found, anchor, config)


def _check_map(found: object, size: tuple[int, int], *, who: str) -> None:
    """Networks may be anybody's: what is no map is told where it comes from."""
    if not isinstance(found, DepthMap):
        raise TypeError(f"{who}.depth_map must return a DepthMap, got {type(found).__name__}")
    depth: object = found.depth
    if not isinstance(depth, np.ndarray) or depth.shape != tuple(size):
        got = f"{type(depth).__name__} {tuple(getattr(depth, 'shape', ()))}"
        raise TypeError(f"{who}.depth_map must give depth as an ndarray {tuple(size)}, got {got}")


def as_photographed(found: DepthMap, anchor: Frame, config: PredictConfig) -> DepthMap:
    """The map of a frame made straight, for the pixels of its photo, in the unit of its pose."""
    if not isinstance(anchor, StraightFrame):
        return found
    return _through_lens(found, anchor, config.size or anchor.photo.image_size)


def found_depths(found: DepthMap) -> FloatArray:
    """Depths ``(D,)`` of the triangulated points of a map."""
    depths: FloatArray = found.keypoints.depth.double().cpu().numpy()
    return depths[depths > 0]


def _in_units_of_capture(found: DepthMap, unit: float) -> DepthMap:
    return found._replace(
        depth=found.depth / np.float32(unit),
        points=found.points / unit,
        keypoints=found.keypoints._replace(depth=found.keypoints.depth / unit),
        work=None if found.work is None else found.work._replace(depth=found.work.depth / unit),
    )


def _through_lens(found: DepthMap, anchor: StraightFrame, size: tuple[int, int]) -> DepthMap:
    """The map of a straight image, for the pixels of the photo; nothing beyond what that shows."""
    place = pixels_of_photo(anchor, size)
    outside = place < 0
    depth = np.where(outside, np.float32(0), found.depth.ravel()[place])
    confidence = found.confidence
    if confidence is not None:
        confidence = np.where(outside, np.float32(0), confidence.ravel()[place])
    log_std = found.log_std
    if log_std is not None:
        log_std = torch.from_numpy(resized(log_std, anchor.image_size).ravel()[place])[None]
    keypoints = found.keypoints
    at = photo_pixels(anchor, keypoints.pixels, keypoints.image_size, size)
    shown = in_photo(anchor, found.points)
    return found._replace(
        depth=depth,
        confidence=confidence,
        points=found.points[shown],
        colors=found.colors[shown],
        keypoints=keypoints._replace(pixels=at, image_size=size),
        log_std=log_std,
    )
