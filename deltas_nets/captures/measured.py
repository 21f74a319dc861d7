"""Depth that a frame comes with: of a sensor, of a reconstruction's points, or measured by hand."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
import torch

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.centres import camera_centres
from deltas_nets.captures.frame import FloatArray, Frame
from deltas_nets.captures.known_depths import points_in_view
from deltas_nets.captures.straight import StraightFrame, straight, straight_pixels
from deltas_nets.captures.text_lines import read_lines
from deltas_nets.captures.work_size import depth_at_image
from deltas_nets.captures.working_depth import working_depths
from deltas_nets.errors import UserError

__all__ = [
    "ByHand",
    "Measured",
    "MeasuredDepth",
    "OfPoints",
    "OfSensor",
    "doubtful_unit",
    "measured_by_hand",
]

FORM = "write lines ID X Y METRES: a frame, a pixel and its depth"
AWAY = 30.0
"""Times as far as anything of the capture: centimetres are a hundred times as many as metres."""


class MeasuredDepth(NamedTuple):
    """What is known of a frame's depth, D places of it.

    Attributes:
        pixels: ``(D, 2)`` of the image, straightened where a lens bends lines.
        depth: ``(D,)`` along z, in the capture's unit.
        deviation: standard deviation as a share of the depth.
    """

    pixels: FloatArray
    depth: FloatArray
    deviation: float


class Measured(Protocol):
    """Where measured depth comes from."""

    def has(self, position: int) -> bool:
        """Whether the frame at a position of the capture may have some; files are not read."""

    def __call__(self, position: int) -> MeasuredDepth | None:
        """That of the frame at a position of the capture; None where there is none.

        Raises:
            UserError: a file cannot be read.
        """


class OfSensor(NamedTuple):
    """Depth images beside the photos."""

    capture: Capture
    deviation: float

    def has(self, position: int) -> bool:
        """See `Measured`."""
        return self.capture.frames.at(position).depth_path is not None

    def __call__(self, position: int) -> MeasuredDepth | None:
        """See `Measured`."""
        frame = self.capture.frames.at(position)
        if frame.depth_path is None:
            return None
        depth = depth_at_image(frame)
        rows, columns = depth.nonzero()
        pixels = np.stack([columns, rows], axis=-1).astype(np.float64)
        return _of_photo(frame, pixels, depth[rows, columns].astype(np.float64), self.deviation)


class OfPoints(NamedTuple):
    """The sparse points that the program which found the poses triangulated."""

    capture: Capture
    deviation: float

    def has(self, position: int) -> bool:
        """See `Measured`."""
        return points_in_view(self.capture, position, least=1) is not None

    def __call__(self, position: int) -> MeasuredDepth | None:
        """See `Measured`."""
        points = points_in_view(self.capture, position, least=1)
        if points is None:
            return None
        pixels = points @ straight(self.capture.frames.at(position)).K.T
        return MeasuredDepth(pixels[:, :2] / pixels[:, 2:], points[:, 2], self.deviation)


class ByHand(NamedTuple):
    """Depths that someone measured at some pixels of some photos, by id: rows X Y METRES."""

    capture: Capture
    rows: Mapping[str, FloatArray]
    deviation: float

    def has(self, position: int) -> bool:
        """See `Measured`."""
        return self.capture.frames.at(position).id in self.rows

    def __call__(self, position: int) -> MeasuredDepth | None:
        """See `Measured`."""
        frame = self.capture.frames.at(position)
        rows = self.rows.get(frame.id)
        if rows is None:
            return None
        return _of_photo(frame, rows[:, :2], rows[:, 2], self.deviation)


def _of_photo(
    frame: Frame, pixels: FloatArray, depth: FloatArray, deviation: float
) -> MeasuredDepth:
    """Depth at pixels of the photo; what a straight image of it does not show is left out."""
    without_lens = straight(frame)
    if isinstance(without_lens, StraightFrame):
        pixels, seen = straight_pixels(without_lens, torch.from_numpy(pixels))
        pixels, depth = pixels[seen], depth[seen]
    return MeasuredDepth(pixels, depth, deviation)


def measured_by_hand(file: Path, capture: Capture) -> dict[str, FloatArray]:
    """The rows X Y METRES ``(D, 3)`` of each frame that a file of measured depths names.

    Args:
        file: lines ``ID X Y METRES``: a frame, a pixel of its photo, and how far along the view
            what it shows is from the camera.
        capture: the frames.

    Raises:
        UserError: the file cannot be read, is empty or malformed, or names a frame or a pixel that
            there is not.
    """
    found: dict[str, list[list[float]]] = {}
    for number, words in read_lines(file, name="file of measured depths", remedy=FORM):
        try:
            # From the right: ids of frames may have spaces, and have a word or more.
            (first, *more), (x, y, metres) = words[:-3], (float(word) for word in words[-3:])
        except ValueError as error:
            raise UserError(f"line {number} is not ID X Y METRES", file, FORM) from error
        id = " ".join([first, *more])
        frame = _named(id, number, file, capture)
        height, width = frame.image_size
        if not 0 < metres < math.inf:
            raise UserError(f"line {number}: {metres:g} m is no depth", file, FORM)
        if not (-0.5 <= x < width - 0.5 and -0.5 <= y < height - 0.5):
            what = f"line {number}: pixel ({x:g}, {y:g}) is outside of frame {id}, {width}x{height}"
            raise UserError(what, file, "give pixels of the photo: x to the right, y down")
        found.setdefault(frame.id, []).append([x, y, metres])
    if not found:
        raise UserError("the file of measured depths is empty", file, FORM)
    return {id: np.array(rows) for id, rows in found.items()}


def _named(id: str, number: int, file: Path, capture: Capture) -> Frame:
    try:
        return capture.frame(id)
    except UserError as error:
        raise UserError(f"line {number}: {error.what}", file, error.remedy) from error


def doubtful_unit(rows: Mapping[str, FloatArray], capture: Capture) -> str | None:
    """Words for measured depths that are hardly in metres, beside a capture that is.

    Args:
        rows: X Y METRES ``(D, 3)`` of each frame.
        capture: its surfaces, as far as it knows them, and its cameras say what is far and near.
    """
    measured = float(np.median(np.concatenate([each[:, 2] for each in rows.values()])))
    usual = float(np.median(working_depths(capture)))
    extent = float(np.ptp(camera_centres(capture.frames.cam_from_world), axis=0).max())
    if min(usual, extent) / AWAY <= measured <= max(usual, extent) * AWAY:
        return None
    return (
        f"measured depths are {measured:.4g} m (median), but surfaces of the capture about "
        f"{usual:.2g} m away and its cameras {extent:.2g} m apart: are they in metres?"
    )
