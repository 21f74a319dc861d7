"""A capture: posed frames of one scene, whatever the folder they came from looks like."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deltas_nets.captures.file_form import OURS, FileForm
from deltas_nets.captures.frame import FloatArray as FloatArray
from deltas_nets.captures.frame import Frame as Frame
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.ids import ids_in_words, nearest_ids
from deltas_nets.captures.images import ImageMemory
from deltas_nets.captures.points import SparsePoints
from deltas_nets.errors import UserError

__all__ = ["Capture", "FloatArray", "Frame", "Lost"]

MEMORY = 512 * 2**20
"""Bytes of decoded images that are kept: 140 of 1296 x 968, or 14 of 12 megapixels."""


class Lost(NamedTuple):
    """Why a frame is not used.

    Attributes:
        reason: "no pose" where there is none or tracking was lost, which happens; "no image" where
            the capture names one that is not there; "malformed" and "not rigid" where a pose is
            there and is none; "no depth" and "listed" where training leaves the frame out.
        error: what asking for the frame raises.
    """

    reason: Literal["no pose", "no image", "malformed", "not rigid", "no depth", "listed"]
    error: UserError


@dataclass(frozen=True, eq=False)
class Capture:
    """The frames of one folder."""

    path: Path
    """The folder that holds the images' folder: the scene, where captures are nested."""
    frames: Frames
    """Frames with a usable pose, in the order of their ids (2 before 10)."""
    lost: Mapping[str, Lost]
    """Frames left out."""
    doubts: tuple[str, ...] = ()
    """What may be a mistake, each for a warning."""
    layout: str = ""
    """The format, in a word or two, as "COLMAP text"."""
    metric: bool = True
    """Whether its unit is the metre; structure from motion alone does not know it."""
    scaled_by: float = 1.0
    """What its poses and points were multiplied with after they were read."""
    depth_scaled_by: float = 1.0
    """The same of its sensor depth, which is in metres already where that told the scale."""
    points: SparsePoints | None = None
    """What the program that found the poses triangulated, if it says so."""
    sources: Mapping[str, tuple[str, ...]] | None = None
    """Ids of the views that the capture's program puts to each frame, best first; empty for those
    that are to have no map. Of frames that are not there it says nothing."""
    depth_ranges: FloatArray | None = None
    """``(F, 2)`` nearest and farthest depth of each frame, if its program states them."""
    form: FileForm = OURS
    """How its files say cameras."""

    @cached_property
    def points_of_frame(self) -> list[NDArray[np.int64]]:
        """``(D,)`` for each frame: positions of the sparse points that it sees, as far as told."""
        if self.points is None:
            return [np.zeros(0, dtype=np.int64)] * len(self.frames)
        point, frame, _ = self.points.seen
        order = np.argsort(frame, kind="stable")
        starts = np.searchsorted(frame[order], np.arange(1, len(self.frames)))
        return np.split(point[order], starts)

    def fingerprint(self) -> str:
        """A hash of all cameras: what changes when poses or intrinsics do."""
        digest = hashlib.sha256()
        for id, frame in self.frames.items():
            digest.update(f"{id} {frame.image_size}".encode())
            digest.update(frame.K.tobytes() + frame.cam_from_world.tobytes())
            digest.update(b"" if frame.lens is None else repr(frame.lens).encode())
        return digest.hexdigest()

    def frame(self, id: str | int) -> Frame:
        """The frame called ``id``; a number is as good as its digits.

        Raises:
            UserError: there is none (names the nearest ids), or its pose was lost.
        """
        id = str(id)
        if id in self.frames:
            return self.frames[id]
        if id in self.lost:
            raise self.lost[id].error
        raise UserError(f"the capture has no frame {id}", self.path, self.instead_of(id))

    def instead_of(self, id: str) -> str:
        """What to do about a frame that there is not."""
        return f"use a frame it has; the nearest are {ids_in_words(nearest_ids(self.frames, id))}"

    def without(self, mask: NDArray[np.bool_], why: Lost) -> "Capture":
        """The capture less the frames of a mask ``(F,)``, which are lost then."""
        if not mask.any():
            return self
        gone = dict.fromkeys(self.frames.kept(mask), why)
        points, ranges = self.points, self.depth_ranges
        return replace(
            self,
            frames=self.frames.kept(~mask),
            lost={**self.lost, **gone},
            points=None if points is None else points._replace(seen=points.seen.kept(~mask)),
            depth_ranges=None if ranges is None else ranges[~mask],
        )

    def remembering(self, capacity: int = MEMORY) -> "Capture":
        """The same capture, which decodes an image once while memory allows.

        Args:
            capacity: bytes that decoded images may take.
        """
        return replace(self, frames=self.frames.remembering(ImageMemory(capacity)))
