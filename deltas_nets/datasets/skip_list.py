"""A file of frames that are not to be used: bad poses, people walking by, lenses covered.

    # scene        frames
    scene0000_00   117
    scene0000_00   300-412
    scene0011_01   *

Words are separated by spaces; what follows a # is a comment; frames are numbers as in the
names of the files, a range holds both of its ends.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deltas_nets.captures.text_lines import read_lines
from deltas_nets.errors import UserError

__all__ = ["SkipList", "read_skip_list"]

_FRAMES = re.compile(r"(\d+)(?:-(\d+))?", re.ASCII)
_FORM = "a line is SCENE FRAME, SCENE FIRST-LAST or SCENE *"


@dataclass(frozen=True)
class SkipList:
    """Frames to leave out, by scene; the default leaves out none."""

    ranges: Mapping[str, tuple[tuple[int, int], ...]] = field(default_factory=dict)
    """First and last of each range."""
    whole: frozenset[str] = frozenset()
    """Scenes that are left out altogether."""

    def listed(self, scene: str, ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which frames of a scene are listed.

        Example:
            >>> SkipList({"a": ((2, 3),)}).listed("a", np.arange(5))
            array([False, False,  True,  True, False])
        """
        listed = np.full(ids.shape, scene in self.whole)
        for first, last in self.ranges.get(scene, ()):
            listed |= (ids >= first) & (ids <= last)
        return listed


def read_skip_list(path: Path) -> SkipList:
    """Read a skip list.

    Raises:
        UserError: the file cannot be read, or a line is of another form; the text has its number.
    """
    ranges: dict[str, tuple[tuple[int, int], ...]] = {}
    whole = set()
    for number, words in read_lines(path, name="skip list", remedy="check --data.skip"):
        if len(words) != 2:
            raise UserError(f"line {number} has {len(words)} words, not 2", path, _FORM)
        scene, frames = words
        if frames == "*":
            whole.add(scene)
            continue
        match = _FRAMES.fullmatch(frames)
        if match is None:
            raise UserError(f"line {number} has {frames[:20]!r} for frames", path, _FORM)
        first, last = int(match[1]), int(match[2] or match[1])
        if last < first:
            raise UserError(f"line {number} ends before it begins ({frames})", path, _FORM)
        ranges[scene] = (*ranges.get(scene, ()), (first, last))
    return SkipList(ranges, frozenset(whole))
