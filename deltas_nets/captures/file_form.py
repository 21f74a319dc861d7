"""How a capture's files say what we read: cures are told in the words of the files."""

from typing import NamedTuple

import numpy as np

from deltas_nets.captures.frame import FloatArray

__all__ = ["OURS", "FileForm"]


class FileForm(NamedTuple):
    """What differs between files and the cameras that are read from them.

    Attributes:
        opengl: whether cameras have OpenGL's axes (y up, z backward) in the files.
        centre: where the centre of the first pixel is in the files; we have it at 0.
    """

    opengl: bool = False
    centre: float = 0.0

    @property
    def axes(self) -> FloatArray:
        """``(4, 4)`` the files' camera axes from ours, and ours from theirs."""
        return np.diag([1.0, -1, -1, 1]) if self.opengl else np.eye(4)


OURS = FileForm()
"""Of files that say cameras as we do."""
