"""MVSNet's folders: cams/00000000_cam.txt, images/00000000.jpg and pair.txt."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.file_form import FileForm
from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.images import in_words
from deltas_nets.captures.readers.cameras import CORNER, camera_of_matrix, fitted
from deltas_nets.captures.readers.collected import Collected
from deltas_nets.captures.readers.numbered import numbered_files
from deltas_nets.captures.readers.poses import cam_from_world
from deltas_nets.captures.text_lines import in_commas, read_text
from deltas_nets.errors import UserError

__all__ = ["read", "recognises"]

PLANES = 192
"""Depths that MVSNet tries where a file states the first and their distance only."""
_CAMERAS, _NUMBERED = ("cams", "cams_1"), ("_cam.txt",)
_IMAGES = ("images", "blended_images", "image")
_DEPTHS = ("rendered_depth_maps", "depths", "depth_gt")
_SUFFIXES = (".png", ".jpg", ".jpeg")
_SCALES = (0.25, 0.5, 2.0, 4.0)
"""By which images are larger than those that their cameras are of: DTU's are for a quarter."""
_REMEDY = "write extrinsic and 4x4 numbers, intrinsic and 3x3, then the nearest depth and a step"


class _Camera(NamedTuple):
    """What a file says; the depths are (nearest, farthest), if stated."""

    cam_from_world: FloatArray
    K: FloatArray
    depths: tuple[float, float] | None


def recognises(path: Path) -> bool:
    """Whether the folder has such a folder of cameras."""
    return _camera_folder(path) is not None


def read(path: Path) -> Capture:
    """Read cameras and pairs; see `deltas_nets.captures.opening.Reader` for the contract."""
    folder = _camera_folder(path)
    if folder is None:
        raise UserError("there is no camera 00000000_cam.txt", path / "cams", _REMEDY)
    cameras = numbered_files(folder, _NUMBERED)
    images, depths = (
        next(filter(None, (numbered_files(path / name, suffixes) for name in names)), {})
        for names, suffixes in ((_IMAGES, _SUFFIXES), (_DEPTHS, (".pfm",)))
    )
    found = Collected(path)
    ranges: dict[str, tuple[float, float] | None] = {}
    rescaled: set[float] = set()
    for number, file in cameras.items():
        id = f"{number:08d}"
        photo = found.photo(id, images.get(number))
        if photo is None:
            continue
        camera = _camera(file)
        pose = cam_from_world(camera.cam_from_world, id=id, path=file)
        K, scale = _of_size(camera.K, photo.size, file)
        rescaled |= {scale} - {1.0}
        ranges[id] = camera.depths
        found.add(photo, pose, K, depth=depths.get(number))
    doubts = [
        f"intrinsics are taken to be of images {1 / scale:g} times as large, {folder}"
        for scale in sorted(rescaled)
    ]
    capture = found.capture(
        path, "MVSNet", metric=False, doubts=doubts, form=FileForm(centre=CORNER)
    )
    stated = [ranges[id] for id in capture.frames]
    known = [depths for depths in stated if depths is not None]
    return replace(
        capture,
        sources=_sources(path, folder, capture.frames),
        depth_ranges=np.array(known).reshape(-1, 2) if len(known) == len(stated) else None,
    )


def _camera_folder(path: Path) -> Path | None:
    if not path.is_dir():
        return None
    return next((path / name for name in _CAMERAS if numbered_files(path / name, _NUMBERED)), None)


def _camera(path: Path) -> _Camera:
    """A file's camera.

    MVSNet samples images at x + 0.5, and its cameras come from COLMAP unchanged: the corner of an
    image is at 0.
    """
    words = read_text(path, name="camera", remedy=_REMEDY)[:65536].split()
    if words[:1] != ["extrinsic"] or words[17:18] != ["intrinsic"] or len(words) < 27:
        raise UserError("the file is no camera of MVSNet", path, _REMEDY)
    try:
        extrinsic, intrinsic, rest = (
            [float(word) for word in part] for part in (words[1:17], words[18:27], words[27:31])
        )
    except ValueError as error:
        what = f"the camera holds words where numbers should be{in_commas(' '.join(words))}"
        raise UserError(what, path, _REMEDY) from error
    return _Camera(
        np.array(extrinsic).reshape(4, 4),
        camera_of_matrix(np.array(intrinsic).reshape(3, 3), path=path, corner=CORNER),
        _depths(rest),
    )


def _depths(stated: Sequence[float]) -> tuple[float, float] | None:
    """Nearest depth, step, number of steps, farthest depth: the last two may be missing."""
    if len(stated) < 2:
        return None
    near, step = stated[:2]
    planes = stated[2] if len(stated) > 2 else PLANES
    far = stated[3] if len(stated) > 3 else near + step * (planes - 1)
    return (near, far) if 0 < near < far < np.inf else None


def _of_size(K: FloatArray, size: tuple[int, int], path: Path) -> tuple[FloatArray, float]:
    """Intrinsics of the images beside them, and by what they are scaled.

    Raises:
        UserError: they are of other images altogether.
    """
    height, width = size
    across, down = width / (2 * K[0, 2] + 1), height / (2 * K[1, 2] + 1)
    for scale in _SCALES:
        if max(abs(across / scale - 1), abs(down / scale - 1)) < 0.15:
            stated = round(height / scale), round(width / scale)
            return fitted(K, stated, size, image=path).K, scale
    if not (0 < K[0, 2] < width and 0 < K[1, 2] < height):
        what = f"the principal point ({K[0, 2]:g}, {K[1, 2]:g}) is outside of images of"
        raise UserError(f"{what} {in_words(size)}", path, "scale the intrinsics to the images")
    return K, 1.0


def _sources(path: Path, cameras: Path, frames: Frames) -> Mapping[str, tuple[str, ...]] | None:
    """Pairs: their number, then for each its view, and how many sources with their scores."""
    file = next((file for place in (path, cameras) if (file := place / "pair.txt").is_file()), None)
    if file is None:
        return None
    remedy = "write the number of views, then for each a line with it and one with N id score ..."
    words = read_text(file, name="list of pairs", remedy=remedy).split()
    sources = {}
    place = 1
    try:
        while place + 1 < len(words):
            view, count = int(words[place]), int(words[place + 1])
            listed = words[place + 2 : place + 2 + 2 * count : 2] if count > 0 else []
            ids = tuple(f"{int(word):08d}" for word in listed)
            place += 2 + 2 * max(count, 0)
            known = tuple(dict.fromkeys(id for id in ids if id in frames))
            if f"{view:08d}" in frames and (known or count <= 0):
                sources[f"{view:08d}"] = tuple(id for id in known if id != f"{view:08d}")
    except ValueError as error:
        raise UserError("the pairs hold words where numbers should be", file, remedy) from error
    return sources if any(sources.values()) else None
