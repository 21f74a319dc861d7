"""Where the depth of a capture's frames comes from: maps that were predicted, or a sensor."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from deltas_geom.cameras.pixels import pixel_grid, resize_intrinsics
from deltas_geom.cameras.poses import invert_pose
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import Frame
from deltas_nets.captures.images import header_of_whole_file
from deltas_nets.captures.straight import StraightFrame, lens_of, photo_pixels, straight
from deltas_nets.errors import UserError
from deltas_nets.fuse.depth_view import DepthView, nearest
from deltas_nets.fuse.deviation import std_of_confidence, std_of_sensor
from deltas_nets.outputs.confidence_maps import confidence_file, read_confidence
from deltas_nets.outputs.depth_formats import MAKE_ANEW, read_depth_map
from deltas_nets.outputs.summary import SUMMARY, read_summary, recorded_depth_scale, unfinished
from deltas_nets.outputs.their_capture import made_of
from deltas_nets.terminal import counted

__all__ = ["DepthSource", "Predicted", "Sensed", "depth_source"]

LEAST_CONFIDENCE = 0.4
"""Of pixels that are used, if nothing else is said."""
MOST_PREDICTED = 160_000
"""Pixels of a predicted map that are used, about as many as the network saw."""
MOST_SENSED = 640 * 480


class DepthSource(Protocol):
    """Depth of some frames of a capture."""

    @property
    def capture(self) -> Capture:
        """The frames, in the unit of the depth."""

    @property
    def ids(self) -> Sequence[str]:
        """Frames that have depth."""

    @property
    def settings(self) -> Mapping[str, Any]:
        """What the depth depends on, for JSON."""

    @property
    def doubt(self) -> str | None:
        """A warning of frames that were to have depth and have none, if there are any."""

    @property
    def least_confidence(self) -> float:
        """Of pixels that are used; 0 where all are."""

    @property
    def doubtful(self) -> Mapping[str, float]:
        """Share of the depth that is less sure than that, of frames whose view was asked for."""

    def check(self) -> None:
        """Raise what reading would, as far as that is quickly told."""

    def view(self, id: str) -> DepthView:
        """The depth of a frame.

        Raises:
            UserError: a file cannot be read.
        """


def depth_source(
    capture: Capture, depths: Path, *, min_confidence: float | None = None
) -> DepthSource:
    """What ``deltas fuse`` calls DEPTHS.

    Args:
        capture: the frames.
        depths: a folder of `deltas depth`, or the word sensor.
        min_confidence: pixels of predicted maps that have less are left out; `LEAST_CONFIDENCE`
            where confidence is stated if not given.

    Raises:
        UserError: there is no such depth, or it is of another capture.
    """
    if min_confidence is not None and not 0 <= min_confidence <= 1:
        what = f"no probability: {min_confidence:g}"
        raise UserError(what, "--min-confidence", "give 0 to 1")
    if str(depths) == "sensor":
        return Sensed(capture)
    return Predicted(capture, depths, min_confidence=min_confidence)


class Predicted:
    """The maps that `deltas depth` wrote of a capture; see `DepthSource`."""

    def __init__(
        self, capture: Capture, folder: Path, *, min_confidence: float | None = None
    ) -> None:
        if read_summary(folder / SUMMARY) is None:
            what = "the folder holds no depth maps of deltas depth"
            raise UserError(what, folder, "run deltas depth first")
        found = made_of(capture, folder)
        summary = found.summary
        self.capture = found.capture
        self._folder = folder
        self._scale = recorded_depth_scale(folder)
        self._has_confidence = "confidence" in summary.get("files", ())
        if min_confidence and not self._has_confidence:
            what = "the maps state no confidence"
            raise UserError(what, "--min-confidence", "leave it out")
        self._least = round(255 * (LEAST_CONFIDENCE if min_confidence is None else min_confidence))
        self.ids, self._missing = found.ids, len(found.missing)
        self.least_confidence = self._least / 255 if self._has_confidence else 0.0
        self.doubtful: dict[str, float] = {}
        self.settings = {"depth": summary["settings"], "min_confidence": self._least / 255}

    @property
    def doubt(self) -> str | None:
        """See `DepthSource`."""
        if not self._missing:
            return None
        waits = unfinished(self._folder)
        said = f"{counted(self._missing, 'map')} of the folder left out, as not finished"
        return said if waits is None else f"{said}: {waits}"

    def check(self) -> None:
        """Raise what reading would, as far as that is quickly told."""
        for id in self.ids:
            for kind in ("depth", "confidence"):
                file = self._folder / kind / f"{id}.png"
                if file.exists() and header_of_whole_file(file) is None:
                    what = f"the {kind} map is no whole PNG"
                    raise UserError(what, file, MAKE_ANEW)

    def view(self, id: str) -> DepthView:
        """The map of a frame."""
        frame = self.capture.frame(id)
        depth = torch.from_numpy(read_depth_map(self._folder, id, self._scale).copy())
        depth = torch.where(depth.isfinite() & (depth > 0), depth, 0.0)
        confidence = None
        if self._has_confidence:
            confidence = torch.from_numpy(read_confidence(self._folder, id))
            if confidence.shape != depth.shape:
                what = "the confidence is not of the depth map's size"
                raise UserError(what, confidence_file(self._folder, id), MAKE_ANEW)
            known = depth > 0
            depth = torch.where(confidence >= self._least, depth, 0.0)
            kept = int((depth > 0).sum()) / max(1, int(known.sum()))
            self.doubtful[id] = 1 - kept if known.any() else 0.0
        return _of_photo(frame, depth, std_of_confidence(depth, confidence), most=MOST_PREDICTED)


class Sensed:
    """What a capture's depth sensor measured; see `DepthSource`."""

    def __init__(self, capture: Capture) -> None:
        self.capture = capture
        depths = capture.frames.arrays.depths
        self.ids = [id for id, depth in zip(capture.frames, depths, strict=True) if depth]
        if not self.ids:
            what = "the capture has no sensor depth"
            raise UserError(what, capture.path, "name a folder of deltas depth")
        if not capture.metric:
            what = "sensor depth is in metres, and the capture is not"
            raise UserError(what, capture.path, "say --scale METRES")
        self.doubt, self.least_confidence = None, 0.0
        self.doubtful: dict[str, float] = {}
        self.settings = {"depth": "sensor", "cameras": capture.fingerprint()}

    def check(self) -> None:
        """Raise what reading would, as far as that is quickly told."""
        for id in self.ids:
            self.capture.frame(id).check_depth()

    def view(self, id: str) -> DepthView:
        """The depth of a frame."""
        frame = self.capture.frame(id)
        depth = torch.from_numpy(frame.read_depth().copy())
        std = std_of_sensor(depth)
        if frame.depth_K is None and frame.cam_from_depth is None:
            return _of_photo(frame, depth, std, most=MOST_SENSED)
        return _of_own_camera(frame, depth, std)


def _step(size: tuple[int, int], most: int) -> int:
    """Every how many pixels of rows and columns, for at most so many in all."""
    step = 1
    while (size[0] // step) * (size[1] // step) > most:
        step += 1
    return step


def _thinned(K: Tensor, step: int) -> Tensor:
    """K of an image of every step-th pixel, from the middle of the first step on."""
    thinned = K.clone()
    thinned[:2] /= step
    thinned[:2, 2] -= step // 2 / step
    return thinned


def _of_photo(frame: Frame, depth: Tensor, std: Tensor, *, most: int) -> DepthView:
    """Depth at the photo's pixels, whatever its size; a lens is undone."""
    size = (depth.shape[0], depth.shape[1])
    camera = straight(frame)
    step = _step(size if camera is frame else camera.image_size, most)
    every = slice(step // 2, None, step)
    pose = torch.tensor(frame.cam_from_world)
    if not isinstance(camera, StraightFrame):
        colors = torch.from_numpy(frame.read_resized(size).copy())
        K = resize_intrinsics(torch.tensor(frame.K), old_size=frame.image_size, new_size=size)
        depth, std, colors = (image[every, every].contiguous() for image in (depth, std, colors))
        return DepthView(depth, std, colors, _thinned(K, step), pose)
    grid = pixel_grid(camera.image_size, dtype=torch.float64).view(*camera.image_size, 2)
    grid = grid[every, every]
    seen = photo_pixels(camera, grid.reshape(-1, 2), camera.image_size, size).view_as(grid)
    depth, std = nearest(depth, seen), nearest(std, seen)
    colors = torch.from_numpy(camera.read_image().copy())[every, every].contiguous()
    K = _thinned(torch.tensor(camera.K), step)
    return DepthView(depth, torch.where(depth > 0, std, 1.0), colors, K, pose)


def _of_own_camera(frame: Frame, depth: Tensor, std: Tensor) -> DepthView:
    """Depth at the pixels of a camera of its own, with the photo's colours where that sees it."""
    size = (depth.shape[0], depth.shape[1])
    if frame.depth_K is None:
        K = resize_intrinsics(torch.tensor(frame.K), old_size=frame.image_size, new_size=size)
    else:
        K = torch.tensor(frame.depth_K)
    cam_from_depth = torch.eye(4, dtype=torch.float64)
    if frame.cam_from_depth is not None:
        cam_from_depth = torch.tensor(frame.cam_from_depth)
    step = _step(size, MOST_SENSED)
    every = slice(step // 2, None, step)
    pose = invert_pose(cam_from_depth) @ torch.tensor(frame.cam_from_world)
    depth, std = depth[every, every].contiguous(), std[every, every].contiguous()
    view = DepthView(depth, std, depth.new_zeros(*depth.shape, 3).byte(), _thinned(K, step), pose)
    points = view.points().double() @ cam_from_depth[:3, :3].T + cam_from_depth[:3, 3]
    pixels, seen = lens_of(frame).project(points.reshape(-1, 3))
    colors = nearest(torch.from_numpy(frame.read_image().copy()), pixels) * seen[:, None]
    return view._replace(colors=colors.view_as(points))
