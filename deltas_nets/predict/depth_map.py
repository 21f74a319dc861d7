"""What is asked of a depth map, and what comes out."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray

from deltas_geom import unproject
from deltas_nets.captures.capture import Capture, Frame
from deltas_nets.captures.measured import MeasuredDepth
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.captures.work_size import camera_at
from deltas_nets.network.known_depth import KnownDepth
from deltas_nets.network.prediction import DepthPrediction

WORK_PIXELS = 120_000
"""Pixels of the image that the network usually sees; see decisions 5 and 26."""
ENLARGED = 2.0
"""How many times as long `deltas depth` makes the sides of smaller photos at most."""


@dataclass(frozen=True)
class PredictConfig:
    """What a depth map depends on besides its frames and the weights."""

    depth_range: tuple[float, float] = (0.5, 10.0)
    """Nearest and farthest depth searched, metres."""
    work_size: tuple[int, int] | None = None
    """(height, width) that the network sees; chosen to suit it if not given."""
    work_pixels: int = WORK_PIXELS
    """How many pixels that has at most, where it is chosen."""
    enlarged: float = 1.0
    """How many times as long the sides of photos of fewer than `WORK_PIXELS` become at most for it;
    networks are scored on photos as they are."""
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
            if size is None:
                continue
            whole = isinstance(size, tuple | list) and len(size) == 2
            if not whole or not all(
                isinstance(side, int | np.integer) and side >= 32 for side in size
            ):
                raise ValueError(f"{name} must be HEIGHT WIDTH of 32 or more, got {size}")
        if not 1 <= self.enlarged < np.inf:
            raise ValueError(f"enlarged must be 1 or more, got {self.enlarged}")
        if not 0 <= self.min_confidence <= 1:
            raise ValueError(f"--min-confidence must be within 0 to 1, got {self.min_confidence}")


class Wanted(NamedTuple):
    """A depth map that a network is asked for.

    Attributes:
        frames: the anchor, whose depth is wanted, and its sources.
        config: sizes, range, confidence.
        measured: depth of the anchor that is known; without sources the map rests on it alone.
    """

    frames: Sequence[Frame]
    config: PredictConfig
    measured: MeasuredDepth | None = None

    @property
    def anchor(self) -> Frame:
        """The frame whose depth is wanted."""
        return self.frames[0]

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of the map."""
        return self.config.size or self.anchor.image_size


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

    @classmethod
    def of(cls, depth: torch.Tensor) -> "KeypointDepths":
        """All pixels of an image ``(1, H, W)`` that have a depth."""
        rows, columns = depth[0].nonzero().unbind(dim=-1)
        pixels = torch.stack([columns, rows], dim=-1).to(depth)
        return cls(pixels, depth[0, rows, columns], (depth.shape[-2], depth.shape[-1]))


class DepthMap(NamedTuple):
    """What any network says of a frame: what is written and scored.

    Attributes:
        depth: ``(H, W)`` float32 metres; 0 where there is none.
        confidence: ``(H, W)`` float32, probability that the relative error is below 5 %; None where
            the network states none.
        points: ``(N, 3)`` float64 in the capture's world, metres.
        colors: ``(N, 3)`` uint8.
        keypoints: the points that the map rests on.
        log_std: ``(1, h, w)`` log of the standard deviation as a share of the depth, at the size
            that the network works at; None where the network states none.
        work: ``(1, h, w)`` what the network says, at that size and of the straight image where
            a lens bends lines, in the capture's unit; None where it states no deviation.
        measured_factor: how many times as far as the triangulated points measured depth says that
            things are; None where nothing was measured, or nothing triangulated.
    """

    depth: NDArray[np.float32]
    confidence: NDArray[np.float32] | None
    points: NDArray[np.float64]
    colors: NDArray[np.uint8]
    keypoints: KeypointDepths
    log_std: torch.Tensor | None = None
    work: KnownDepth | None = None
    measured_factor: float | None = None


def finished_map(
    anchor: Frame, work: KnownDepth, keypoints: KeypointDepths, config: PredictConfig
) -> DepthMap:
    """What is written and scored of a map ``(1, h, w)`` at the size that the network works at."""
    size = config.size or anchor.image_size
    depth = resized(work.depth, size)
    confidence = resized(work.confidence(), size)
    kept = confidence >= config.min_confidence
    work_size = (work.depth.shape[-2], work.depth.shape[-1])
    points, colors = point_cloud(anchor, depth * kept, size, work_size)
    # In logs, as the network forms it: the order of neighbours stays.
    log_std = work.deviation.log()
    return DepthMap(np.where(kept, depth, 0), confidence, points, colors, keypoints, log_std, work)


def keypoint_depths(prediction: DepthPrediction) -> KeypointDepths:
    """The triangulated points of a prediction without batch dims."""
    return KeypointDepths(
        prediction.keypoints.pixels,
        prediction.points.depth[0],
        (prediction.depth.shape[-2], prediction.depth.shape[-1]),
    )


def resized(image: torch.Tensor, size: tuple[int, int]) -> NDArray[np.float32]:
    """An image ``(1, h, w)`` at another size ``(H, W)``, linearly between its pixels."""
    resized = F.interpolate(image[None], size=size, mode="bilinear", align_corners=False)
    array: NDArray[np.float32] = resized[0, 0].float().cpu().numpy()
    return array


def point_cloud(
    anchor: Frame, depth: NDArray[np.float32], size: tuple[int, int], work_size: tuple[int, int]
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """World points of the map, about as many as the network has pixels, with their colours."""
    step = max(1, round(size[0] / work_size[0]))
    rows, columns = np.mgrid[step // 2 : size[0] : step, step // 2 : size[1] : step].reshape(2, -1)
    z = torch.from_numpy(depth[rows, columns]).double()
    pixels = torch.from_numpy(np.stack([columns, rows], axis=-1)).double()
    points = unproject(camera_at(anchor, size), pixels[None], z[None])[0]
    colors = anchor.read_resized(size)[rows, columns]
    known = z.numpy() > 0
    in_world: NDArray[np.float64] = points.numpy()[known]
    return in_world, colors[known]


def frames_of(capture: Capture, views: ViewSet) -> list[Frame]:
    """The anchor, then its sources."""
    return [capture.frame(id) for id in (views.anchor, *views.sources)]
