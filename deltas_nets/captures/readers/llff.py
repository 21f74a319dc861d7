"""LLFF: poses_bounds.npy beside the photos, as forward-facing scenes of NeRF have it."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.float_files import read_npy_array
from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.ids import ids_in_words
from deltas_nets.captures.readers.cameras import camera_matrix
from deltas_nets.captures.readers.collected import Collected
from deltas_nets.captures.readers.listed import listed
from deltas_nets.captures.readers.names import IMAGE_SUFFIXES, frame_ids
from deltas_nets.captures.readers.poses import cam_from_world_of
from deltas_nets.captures.rigid import rigid
from deltas_nets.errors import UserError

__all__ = ["read", "recognises"]

NAME = "poses_bounds.npy"
_FOLDERS = ("images", "images_2", "images_4", "images_8")
_LIMIT = 2**26
_REMEDY = "run imgs2poses.py of LLFF again, or name the COLMAP model that it made them of"


def recognises(path: Path) -> bool:
    """Whether the folder has the file, or is it."""
    return path.name == NAME if path.is_file() else (path / NAME).is_file()


def read(path: Path) -> Capture:
    """Read poses and photos; see `deltas_nets.captures.opening.Reader` for the contract.

    A row holds a matrix of 3 x 5 and the nearest and farthest depth. The matrix is camera-to-world
    with axes down, right, backward, then height, width and focal length. Photos are those of the
    folder in the order of their names, and their centre is the principal point.
    """
    folder = path.parent if path.is_file() else path
    file = folder / NAME
    rows = _rows(file)
    photos = _photos(folder, len(rows))
    ids = frame_ids([photo.name for photo in photos], file)
    found = Collected(file)
    ranges = {}
    for id, photo_path, row in zip(ids, photos, rows, strict=True):
        photo = found.photo(id, photo_path)
        if photo is None:
            continue
        matrix = row[:15].reshape(3, 5)
        down, right, back, centre, camera = matrix.T
        pose = cam_from_world_of(
            rigid(np.stack([right, down, -back], axis=1), centre), id=id, path=file
        )
        height, width, focal = camera
        if not (np.isfinite(camera).all() and (camera[:2] >= 1).all()):
            raise UserError(f"the camera of {id} is none", file, _REMEDY)
        K = camera_matrix(focal, focal, (width - 1) / 2, (height - 1) / 2, path=file)
        found.add(photo, pose, K, stated=(round(height), round(width)))
        ranges[id] = row[15:]
    capture = found.capture(folder, "LLFF", metric=False)
    stated = np.array([ranges[id] for id in capture.frames]).reshape(-1, 2)
    good = bool(((stated[:, 0] > 0) & (stated[:, 0] < stated[:, 1])).all())
    good = good and bool(np.isfinite(stated).all())
    return replace(capture, depth_ranges=stated if good else None)


def _rows(file: Path) -> FloatArray:
    """``(F, 17)``."""
    with file.open("rb") as opened:
        array = read_npy_array(opened.read(_LIMIT), file)
    if array.ndim != 2 or array.shape[1] != 17 or not len(array):
        raise UserError(f"{NAME} has shape {array.shape}, not (photos, 17)", file, _REMEDY)
    return array.astype(np.float64)


def _photos(folder: Path, count: int) -> Sequence[Path]:
    """The photos that the rows are of: of the first folder that has as many."""
    numbers = {}
    for name in _FOLDERS:
        inside = folder / name
        photos = sorted(listed(inside, *IMAGE_SUFFIXES)) if inside.is_dir() else []
        if len(photos) == count:
            return photos
        numbers[name] = len(photos)
    there = ids_in_words(f"{name}: {number}" for name, number in numbers.items() if number)
    what = f"the file has {count} poses, the folders of photos hold others ({there or 'none'})"
    raise UserError(what, folder / NAME, "put the photos of the poses there, those alone")
