"""DeMoN's data as DPSNet prepared it: cam.txt, poses.txt, 0000.jpg and 0000.npy of depth."""

from array import array
from pathlib import Path

import numpy as np

from deltas_nets.captures.camera_words import Intrinsics
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.readers.collected import Collected
from deltas_nets.captures.readers.image_sizes import size_of_first
from deltas_nets.captures.readers.intrinsics import read_intrinsics
from deltas_nets.captures.readers.numbered import numbered_files
from deltas_nets.captures.readers.poses import cam_from_world
from deltas_nets.captures.text_lines import read_lines
from deltas_nets.errors import UserError

__all__ = ["read", "read_with", "recognises"]

_REMEDY = "write a line of 12 numbers for each image, world-to-camera"


def recognises(path: Path) -> bool:
    """Whether the folder has the two files."""
    return (path / "cam.txt").is_file() and (path / "poses.txt").is_file()


def read(path: Path) -> Capture:
    """Read one scene; see `deltas_nets.captures.opening.Reader` for the contract."""
    return read_with(path, None)


def read_with(path: Path, intrinsics: Intrinsics | None) -> Capture:
    """Read one scene; see `deltas_nets.captures.opening.ReaderOfPoses` for the contract."""
    file = path / "poses.txt"
    rows = _rows(file)
    images = numbered_files(path, (".jpg", ".jpeg", ".png"))
    depths = numbered_files(path, (".npy",))
    if intrinsics is None:
        K = read_intrinsics(path / "cam.txt", size_of_first(images.values()))
        intrinsics = Intrinsics(K, None)
    found = Collected(path)
    for number in sorted(images.keys() | set(range(len(rows)))):
        id = f"{number:04d}"
        if number >= len(rows):
            what = f"frame {id} has no pose"
            found.without_pose(id, UserError(what, file, _REMEDY))
            continue
        photo = found.photo(id, images.get(number))
        if photo is not None:
            pose = cam_from_world(rows[number].reshape(3, 4), id=id, path=file)
            found.add(photo, pose, intrinsics.K, lens=intrinsics.lens, depth=depths.get(number))
    return found.capture(path, "DeMoN", metric=True)


def _rows(path: Path) -> FloatArray:
    """``(F, 12)``."""
    numbers = array("d")
    for number, words in read_lines(path, name="list of poses", remedy=_REMEDY):
        if len(words) != 12:
            raise UserError(f"line {number} has {len(words)} numbers, not 12", path, _REMEDY)
        try:
            numbers.extend(map(float, words))
        except ValueError as error:
            what = f"line {number} holds {' '.join(words)[:40]!r} where numbers should be"
            raise UserError(what, path, _REMEDY) from error
    return np.array(numbers).reshape(-1, 12)
