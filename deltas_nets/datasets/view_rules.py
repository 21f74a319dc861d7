"""Which frames of a scene are looked at together: by their numbers, or by where they stand."""

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from deltas_nets.captures.centres import camera_centres
from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.view_choice import spread_sources

__all__ = ["ByBaseline", "ByGap", "ViewRule"]

ROWS = 256  # anchors whose distances to all frames are in memory at once


class ViewRule(Protocol):
    """A way to choose the sources of an anchor; positions are of a scene's frames."""

    def anchors(self, frames: Frames) -> NDArray[np.intp]:
        """Positions of the frames that have enough sources, ascending."""

    def sources(self, frames: Frames, anchor: int) -> list[int]:
        """Positions of an anchor's sources, best first."""

    def in_words(self) -> str:
        """For messages: "3 views 20 frames apart"."""


class ByGap(NamedTuple):
    """Views ``gap`` frame numbers apart, the anchor in their middle.

    The paper says "three views at a fixed interval of 20 frames" (section 4.1) and not which of
    them is the anchor; in the middle it shares most with the others. Of an even number one more
    is before it. Only the frames of a view set must be usable, not those between them.

    Attributes:
        gap: from one view to the next.
        num_views: V, the anchor among them.
    """

    gap: int
    num_views: int

    def offsets(self) -> list[int]:
        """Frame numbers of the sources less the anchor's, nearest first.

        Example:
            >>> ByGap(20, 3).offsets(), ByGap(15, 4).offsets()
            ([-20, 20], [-15, 15, -30])
        """
        return [(-1) ** k * ((k + 1) // 2) * self.gap for k in range(1, self.num_views)]

    def anchors(self, frames: Frames) -> NDArray[np.intp]:
        """Frames whose sources are all usable."""
        numbers = frames.numbers
        complete = np.ones(len(numbers), dtype=bool)
        for offset in self.offsets():
            complete &= np.isin(numbers + offset, numbers, assume_unique=True)
        return np.flatnonzero(complete)

    def sources(self, frames: Frames, anchor: int) -> list[int]:
        """Positions of the sources, nearest first, the earlier one of two."""
        numbers = frames.numbers
        wanted = numbers[anchor] + np.array(self.offsets())
        return [int(position) for position in np.searchsorted(numbers, wanted)]

    def in_words(self) -> str:
        """How views are chosen."""
        return f"{self.num_views} views {self.gap} frames apart"


class ByBaseline(NamedTuple):
    """Sources at a distance from the anchor, looking the same way, on different sides of it.

    Of the frames that qualify those that turn least are taken, each discounted by how nearly it
    repeats one that was taken, as for captures.

    Attributes:
        low: least distance, metres.
        high: greatest distance, metres.
        max_rotation: largest angle of the relative rotation, radians.
        num_views: V, the anchor among them.
    """

    low: float
    high: float
    max_rotation: float
    num_views: int

    def anchors(self, frames: Frames) -> NDArray[np.intp]:
        """Frames with enough candidates."""
        enough = [
            self._qualify(frames, slice(first, first + ROWS))[0].sum(axis=1) >= self.num_views - 1
            for first in range(0, len(frames), ROWS)
        ]
        return np.flatnonzero(np.concatenate(enough)) if enough else np.zeros(0, dtype=np.intp)

    def sources(self, frames: Frames, anchor: int) -> list[int]:
        """Positions of the sources, best first."""
        qualify, cosines = self._qualify(frames, slice(anchor, anchor + 1))
        near = np.flatnonzero(qualify[0])
        centres = camera_centres(frames.cam_from_world)
        offsets = (centres[near] - centres[anchor]) @ frames.cam_from_world[anchor, :3, :3].T
        angles = np.arccos(np.clip(cosines[0, near], -1, 1))
        log_score = -0.5 * (angles / (0.5 * self.max_rotation)) ** 2
        chosen = spread_sources(log_score, offsets, self.num_views - 1)
        return [int(near[index]) for index in chosen]

    def in_words(self) -> str:
        """How views are chosen."""
        angle = np.degrees(self.max_rotation)
        return f"{self.num_views} views {self.low:g} to {self.high:g} m and {angle:g} degrees apart"

    def _qualify(self, frames: Frames, anchors: slice) -> tuple[NDArray[np.bool_], FloatArray]:
        """``(A, F)`` whether frames may be sources of the anchors, and cosines of their angles."""
        centres = camera_centres(frames.cam_from_world)
        rotations = frames.cam_from_world[:, :3, :3].reshape(-1, 9)
        distances = np.linalg.norm(centres[anchors, None] - centres, axis=-1)
        # The trace of R_a R_b^T is the sum of the products of their entries.
        cosines: FloatArray = (rotations[anchors] @ rotations.T - 1) / 2
        alike = cosines >= np.cos(self.max_rotation)
        return (distances >= self.low) & (distances <= self.high) & alike, cosines
