"""Scenes to train on: captures less the frames without depth, and counts of what is missing."""

from collections import Counter
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deltas_nets.captures.capture import Capture, Lost
from deltas_nets.captures.readers import scannet
from deltas_nets.errors import UserError

__all__ = ["LeftOut", "left_out", "read_scene", "skipped"]


@dataclass(frozen=True)
class LeftOut:
    """How many frames are not used, and why; each is counted once."""

    lost: int = 0
    """Their pose is missing, damaged or not finite."""
    not_rigid: int = 0
    """Their pose is no rotation and translation."""
    without_depth: int = 0
    """They have no depth file."""
    listed: int = 0
    """They are in the skip list."""

    def __add__(self, other: "LeftOut") -> "LeftOut":
        names = [field.name for field in fields(self)]
        return LeftOut(**{name: getattr(self, name) + getattr(other, name) for name in names})

    def in_words(self) -> str:
        """The counts for a message.

        Example:
            >>> LeftOut(lost=2, listed=1).in_words()
            '2 without a finite pose, 0 whose pose is not rigid, 0 without depth, 1 listed'
        """
        return (
            f"{self.lost} without a finite pose, {self.not_rigid} whose pose is not rigid, "
            f"{self.without_depth} without depth, {self.listed} listed"
        )


def left_out(scene: Capture) -> LeftOut:
    """Counts of a scene's lost frames."""
    counts = Counter(lost.reason for lost in scene.lost.values())
    return LeftOut(
        lost=counts["no pose"] + counts["malformed"],
        not_rigid=counts["not rigid"],
        without_depth=counts["no depth"],
        listed=counts["listed"],
    )


def read_scene(path: Path) -> Capture:
    """Read the poses of a scene.

    Frames without depth or without a finite, rigid pose are lost and counted: in a thousand scenes
    there are always some, and none of them is worth an evening.

    Args:
        path: the folder that holds color, depth, pose and intrinsic.

    Raises:
        UserError: a folder, the images or the intrinsics are missing or malformed.
        OSError: the system refuses to read a file.
    """
    scene = scannet.read(path)
    why = UserError("the frame has no sensor depth", path / "depth", "add the file")
    return scene.without(scene.frames.arrays.depths == b"", Lost("no depth", why))


def skipped(scene: Capture, listed: NDArray[np.bool_]) -> Capture:
    """The scene less the frames ``(F,)`` that a skip list names."""
    why = UserError("the frame is in the skip list", scene.path, "take it out of --data.skip")
    return scene.without(listed, Lost("listed", why))
