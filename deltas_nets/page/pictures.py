"""What a frame looks like: its image, its depth, how sure that is, and how wrong."""

import io
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from deltas_nets.captures.frame import Frame
from deltas_nets.captures.register import register_depth
from deltas_nets.captures.spread import spread
from deltas_nets.captures.work_size import depth_at_image
from deltas_nets.errors import UserError
from deltas_nets.evaluate.depth_metrics import DepthMetrics
from deltas_nets.evaluate.scores import resize_nearest, score_map
from deltas_nets.page.colours import CONFIDENCE, ERROR, Scale, coloured
from deltas_nets.page.maps import Maps

__all__ = [
    "LONGEST",
    "FramePictures",
    "jpeg",
    "pictures_of",
    "sample_of_depth",
    "scales_of",
    "size_within",
]

LONGEST = 640
"""Pixels of the longer side of a picture, at most."""
QUALITY = {"image": 78, "truth": 70, "error": 70}
MAP_QUALITY = 82
SAMPLED_MAPS, SAMPLED_PIXELS = 40, 5000

Picture = NDArray[np.uint8]


class FramePictures(NamedTuple):
    """Pictures of a frame, all of one size.

    Attributes:
        id: of the frame.
        pictures: ``(H, W, 3)`` by name: image, depth and, where they are known, confidence, truth
            and error.
        score: against sensor depth; None where there is none.
        unread: why there is none, though there is a file of it.
    """

    id: str
    pictures: dict[str, Picture]
    score: DepthMetrics | None
    unread: UserError | None = None


def sample_of_depth(maps: Maps) -> NDArray[np.float32]:
    """Depths of some pixels of some maps, spread over the capture, from which colours follow."""
    found = []
    for id in spread(maps.ids, SAMPLED_MAPS):
        depth = maps.depth(id).ravel()
        depth = depth[:: max(1, len(depth) // SAMPLED_PIXELS)]
        found.append(depth[depth > 0])
    return np.concatenate(found)


def scales_of(depth: Scale) -> Mapping[str, Scale]:
    """The scale of each kind of picture that has one."""
    return {"depth": depth, "confidence": CONFIDENCE, "truth": depth, "error": ERROR}


def size_within(shape: tuple[int, ...], longest: int) -> tuple[int, int]:
    """(height, width) of a picture whose longer side is at most so many pixels.

    Example:
        >>> size_within((480, 640), 320), size_within((48, 64), 320)
        ((240, 320), (48, 64))
    """
    share = min(1.0, longest / max(shape))
    return max(1, round(share * shape[0])), max(1, round(share * shape[1]))


def pictures_of(
    maps: Maps,
    id: str,
    depth: NDArray[np.float32],
    scale: Scale,
    depth_range: tuple[float, float],
    longest: int = LONGEST,
) -> FramePictures:
    """A frame's pictures.

    Args:
        maps: of the capture.
        id: of a frame that has a map.
        depth: ``(H, W)``, the map.
        scale: of depth.
        depth_range: (near, far) of the true depth that counts for the score, metres.
        longest: pixels of the longer side; never more than the map has.

    Raises:
        UserError: a file cannot be read, and it is not that of the sensor depth.
    """
    frame, confidence = maps.capture.frame(id), maps.confidence(id)
    size = size_within(depth.shape, longest)
    small = resize_nearest(depth, size)
    pictures = {
        "image": frame.read_resized(size),
        "depth": coloured(small, scale, known=small > 0),
    }
    if confidence is not None:
        sure = 100 * resize_nearest(confidence, size)
        pictures["confidence"] = coloured(sure, CONFIDENCE, known=small > 0)
    try:
        truth = _true_depth(frame, maps)
    except UserError as refused:  # a page without the errors of a frame is better than none
        return FramePictures(id, pictures, None, refused)
    if truth is None:
        return FramePictures(id, pictures, None)
    score = score_map(depth, truth, depth_range, None)
    truth = resize_nearest(truth, size)
    both = (truth > 0) & (small > 0)
    error = 100 * np.abs(small - truth) / np.where(both, truth, 1)
    pictures["truth"] = coloured(truth, scale, known=truth > 0)
    pictures["error"] = coloured(error, ERROR, known=both)
    return FramePictures(id, pictures, None if score is None else score.dense)


def jpeg(picture: Picture, kind: str) -> bytes:
    """A picture as a file; maps keep the colour of every pixel, as it is read back as a number."""
    file = io.BytesIO()
    photo = kind == "image"
    Image.fromarray(picture).save(
        file,
        format="JPEG",
        quality=QUALITY.get(kind, MAP_QUALITY),
        subsampling=2 if photo else 0,
    )
    return file.getvalue()


def _true_depth(frame: Frame, maps: Maps) -> NDArray[np.float32] | None:
    """What a sensor measured, at the size of the image, where it and the map are in metres."""
    if frame.depth_path is None or maps.unit != "m":
        return None
    return depth_at_image(frame) if frame.cam_from_depth is None else register_depth(frame)
