"""A capture that cannot even be read: why, and, where one file of numbers is to blame, as mended.

Readers refuse intrinsics that cannot be of the images. What they should have been often follows
from the numbers; then the capture is read with that file rewritten, and the check goes on.
"""

import re
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.opening import open_capture
from deltas_nets.check.finding import Fault, Finding
from deltas_nets.check.intrinsics import suspicion_of
from deltas_nets.errors import UserError

__all__ = ["Refused", "refused"]

_LARGEST = 4096  # bytes of a file with one matrix
_MOST_FILES = 100_000
_SIZE = re.compile(r"images of (\d+)x(\d+)")
_NO_POSES = {
    re.compile(r"\bpose\b.* mirrors:"): Fault.POSES_MIRROR,
    re.compile(r"\bpose\b.* scales by"): Fault.POSES_SCALE,
    re.compile(r"\bpose\b.* is transposed:"): Fault.POSES_TRANSPOSED,
    re.compile(r"\bpose\b.* (is not rigid:|has the last row)"): Fault.REFUSED,
}
"""What readers say of a matrix that is no pose, which is no K either."""
_OF_OTHER_SIZE = re.compile(r"image is (\d+)x(\d+), its camera is for (\d+)x(\d+)")


class Refused(NamedTuple):
    """What a reader refused.

    Attributes:
        finding: why, and the cure.
        capture: read with the cure, where it is known; for more checks.
    """

    finding: Finding
    capture: Capture | None


def refused(path: Path, error: UserError) -> Refused:
    """The error of reading a capture, as a finding.

    Args:
        path: of the capture.
        error: that reading it raised.

    Raises:
        UserError: there is nothing at the path that could be checked.
    """
    if not path.is_dir() and not path.is_file():
        raise error
    evidence = f"{error.what}, {error.where}"
    of_pose = next((fault for words, fault in _NO_POSES.items() if words.search(error.what)), None)
    cause = of_pose or Fault.REFUSED
    plain = Refused(Finding(cause, evidence, (), error.remedy, "error"), None)
    if of_pose is not None:
        return plain
    matrix = _matrix(Path(error.where))
    if matrix is not None:
        return _of_intrinsics(path, error, matrix) or plain
    sizes = _OF_OTHER_SIZE.search(error.what)
    if sizes is not None and sizes.groups()[:2] == sizes.groups()[3:1:-1]:
        cure = f"write width {sizes[1]} and height {sizes[2]}; if K is of the swapped size too, "
        cure += f"exchange fx with fy and cx with cy; or {error.remedy}"
        return Refused(Finding(Fault.SIDES_SWAPPED, evidence, (), cure, "error"), None)
    return plain


def _of_intrinsics(path: Path, error: UserError, matrix: FloatArray) -> Refused | None:
    K = matrix[:3, :3]
    size = _SIZE.search(error.what)
    # Of a transposed matrix no size is needed; any that its centre fits will do.
    height, width = (int(size[2]), int(size[1])) if size else (2 * K[2, 1] + 1, 2 * K[2, 0] + 1)
    suspicion = suspicion_of(K, (max(int(height), 1), max(int(width), 1)))
    if suspicion is None or suspicion.right is None:
        return None
    evidence = f"{suspicion.evidence}, {error.where}"
    cure = f"{suspicion.cure}, in {error.where}"
    right = np.eye(len(matrix))
    right[:3, :3] = suspicion.right
    capture = _read_with(path, Path(error.where), right)
    mend = None if capture is None else (lambda capture: capture)
    return Refused(Finding(suspicion.cause, evidence, (), cure, "error", mend), capture)


def _matrix(path: Path) -> FloatArray | None:
    """``(3, 3)`` or ``(4, 4)`` of a small text file, or None."""
    try:
        if not path.is_file() or path.stat().st_size > _LARGEST:
            return None
        numbers = np.array([float(word) for word in path.read_text().split()])
    except (OSError, ValueError):
        return None
    side = {9: 3, 16: 4}.get(len(numbers))
    if side is None or not np.isfinite(numbers).all():
        return None
    return numbers.reshape(side, side)


def _read_with(path: Path, file: Path, matrix: FloatArray) -> Capture | None:
    """The capture with one file rewritten, in a folder of links that is gone afterwards."""
    if not file.is_relative_to(path):
        return None
    with tempfile.TemporaryDirectory() as folder:
        other = Path(folder) / path.name
        if not _linked(path, other, file.relative_to(path)):
            return None
        np.savetxt(other / file.relative_to(path), matrix, fmt="%.10g")
        try:
            capture = open_capture(other)
        except UserError:
            return None
        scene = path / capture.path.relative_to(other)
        frames = Frames(scene, capture.frames.arrays)
        if capture.frames.folder != capture.path:
            return None
        return replace(capture, path=scene, frames=frames)


def _linked(path: Path, other: Path, without: Path) -> bool:
    """Link what a folder holds, but for one file whose folders are made."""
    for depth in range(len(without.parts)):
        parent = Path(*without.parts[:depth])
        (other / parent).mkdir(parents=True)
        for count, inner in enumerate((path / parent).iterdir()):
            if count > _MOST_FILES:
                return False
            if inner.name != without.parts[depth]:
                (other / parent / inner.name).symlink_to(inner.absolute())
    return True
