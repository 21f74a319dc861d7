"""Strecha's multi-view benchmark: 0000.jpg and 0000.jpg.camera."""

import contextlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.readers.cameras import camera_of_matrix
from deltas_nets.captures.readers.collected import Collected
from deltas_nets.captures.readers.files import FileFinder
from deltas_nets.captures.readers.listed import listed
from deltas_nets.captures.readers.names import frame_ids
from deltas_nets.captures.readers.poses import cam_from_world_of
from deltas_nets.captures.rigid import rigid
from deltas_nets.captures.text_lines import read_numbers
from deltas_nets.errors import UserError

__all__ = ["read", "recognises"]

_REMEDY = "write K (3x3), three zeros, R (3x3, camera-to-world), the centre, width and height"


def recognises(path: Path) -> bool:
    """Whether the folder, or one in it, holds .camera files."""
    return bool(_cameras(path))


def read(path: Path) -> Capture:
    """Read cameras; see `deltas_nets.captures.opening.Reader` for the contract."""
    files = _cameras(path)
    names = [file.name.removesuffix(".camera") for file in files]
    ids = frame_ids(names, files[0].parent) if files else []
    finder = FileFinder(path, (files[0].parent, path / "images")) if files else FileFinder(path)
    found, bent = Collected(path), 0
    for file, name, id in zip(files, names, ids, strict=True):
        photo = found.photo(id, finder.find(name) or finder.find(Path(name).stem))
        if photo is None:
            continue
        numbers = np.array(read_numbers(file, name="camera", remedy=_REMEDY))
        if len(numbers) != 26:
            what = f"the camera file has {len(numbers)} numbers, not 26"
            raise UserError(what, file, _REMEDY)
        K, bends, rotation, centre, sides = np.split(numbers, (9, 12, 21, 24))
        bent += bool(bends.any())
        pose = cam_from_world_of(rigid(rotation.reshape(3, 3), centre), id=id, path=file)
        if not (np.isfinite(sides).all() and (sides >= 1).all()):
            raise UserError("the camera's width and height are no sizes", file, _REMEDY)
        stated = int(sides[1]), int(sides[0])
        matrix = camera_of_matrix(K.reshape(3, 3), path=file)
        found.add(photo, pose, matrix, stated=stated)
    doubts = finder.doubts()
    if bent:
        doubts.append(f"{bent} cameras state a distortion, which is not undone, {path}")
    return found.capture(path, "Strecha", metric=False, doubts=doubts)


def _cameras(path: Path) -> Sequence[Path]:
    """Of the folder, or of the first in it that has some."""
    if not path.is_dir():
        return ()
    found = sorted(listed(path, ".camera"))
    for each in () if found else sorted(listed(path)):
        with contextlib.suppress(OSError):  # no folder, or not ours to read
            found = sorted(listed(each, ".camera"))
        if found:
            break
    return found
