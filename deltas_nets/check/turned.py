"""Images that were turned when their cameras were not, as phones and viewers do by EXIF."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deltas_nets.captures.frame import FloatArray, Frame
from deltas_nets.captures.frames import Frames
from deltas_nets.check.finding import Fault, Finding
from deltas_nets.check.mending import changing_frames
from deltas_nets.check.trying import Case, Suspect

__all__ = ["Turn", "turned_images", "turned_images_of_right_K"]

BACK = {1: "90 degrees clockwise", 2: "180 degrees", 3: "90 degrees counterclockwise"}
"""By the quarters that images were turned counterclockwise."""


class Turn(NamedTuple):
    """How images were turned, and what was not.

    Attributes:
        quarters: counterclockwise.
        with_K: whether K is of the images before, as poses are.
        shape: of the images that were turned, where others stay as they are; all if empty.
    """

    quarters: int
    with_K: bool
    shape: str = ""

    def ids(self, frames: Frames) -> tuple[str, ...]:
        """Frames whose images were turned, where others were not."""
        return tuple(frames.kept(_SHAPES[self.shape](frames.image_sizes))) if self.shape else ()

    def mended(self, _: int, frame: Frame) -> Frame:
        """The frame with the camera of its image as it is."""
        if self.shape and not _SHAPES[self.shape](np.array([frame.image_size]))[0]:
            return frame
        K, pose, (height, width) = frame.K, frame.cam_from_world, frame.image_size
        if self.quarters % 2:  # back to the size that the camera is of
            height, width = width, height
        for _quarter in range(self.quarters):
            # What was at (x, y) is at (y, width - 1 - x).
            if self.with_K:
                (fx, cx), (fy, cy) = (K[0, 0], K[0, 2]), (K[1, 1], K[1, 2])
                K = np.array([[fy, 0.0, cy], [0.0, fx, width - 1 - cx], [0.0, 0.0, 1.0]])
            pose = _QUARTER @ pose
            height, width = width, height
        return replace(frame, K=K, cam_from_world=pose)

    @property
    def images(self) -> str:
        """Which images were turned, in words."""
        return f"the {self.shape} images" if self.shape else "the images"

    @property
    def cure(self) -> str:
        """What to do to the files."""
        unturned = "K and poses" if self.with_K else "poses"
        cure = f"turn {self.images} back by {BACK[self.quarters]}"
        if not self.with_K:
            cure += ", and K with them"
        return f"{cure}; or write {unturned} of the images as they are"


_SHAPES: Mapping[str, Callable[[NDArray[np.int64]], NDArray[np.bool_]]] = {
    "portrait": lambda sizes: sizes[:, 0] > sizes[:, 1],
    "landscape": lambda sizes: sizes[:, 0] < sizes[:, 1],
}
"""Which images have a shape, by their sizes ``(F, 2)``, (height, width)."""
_QUARTER: FloatArray = np.array(
    [[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=np.float64
)
"""What points to the right points up in an image that was turned by a quarter."""


def turned_images_of_right_K(case: Case) -> Iterator[Suspect]:
    """Quarters of a turn that poses do not know; half a turn would be axes that programs have."""
    return _tried(case, (Turn(1, False), Turn(3, False)))


def turned_images(case: Case) -> Iterator[Suspect]:
    """Turns that neither K nor poses know."""
    return _tried(case, (Turn(1, True), Turn(2, True), Turn(3, True)))


def _tried(case: Case, turns: tuple[Turn, ...]) -> Iterator[Suspect]:
    sizes = case.capture.frames.image_sizes
    mixed = all(of_shape(sizes).any() for of_shape in _SHAPES.values())
    # Phones turn what was taken upright, and nothing else.
    shapes = ("", *_SHAPES) if mixed else ("",)
    for turn in (turn._replace(shape=shape) for shape in shapes for turn in turns):
        mend = changing_frames(turn.mended)
        found = case.mended(mend)
        if found.explains:
            fault = Fault.IMAGES_TURNED if turn.with_K else Fault.IMAGES_TURNED_BESIDE_POSES
            what = f"{turn.images} turned back by {BACK[turn.quarters]} fit: {found.in_words}"
            ids = turn.ids(case.capture.frames)
            yield Suspect(found, Finding(fault, what, ids, turn.cure, "error", mend))
