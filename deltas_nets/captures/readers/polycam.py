"""Polycam's raw data: keyframes with a JSON file of each camera."""

from pathlib import Path

import numpy as np

from deltas_nets.captures.capture import Capture, Lost
from deltas_nets.captures.file_form import FileForm
from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.readers.cameras import CORNER, camera_matrix
from deltas_nets.captures.readers.collected import Collected
from deltas_nets.captures.readers.json_file import Fields, read_json
from deltas_nets.captures.readers.listed import listed
from deltas_nets.captures.readers.poses import OPENGL, cam_from_world_of
from deltas_nets.errors import UserError

__all__ = ["read", "recognises"]

_REMEDY = "export raw data from Polycam again"
_JSON_LIMIT = 2**20
_KINDS = (
    ("corrected_cameras", "corrected_images"),
    ("cameras", "images"),
    ("corrected_cameras", "images"),
)
"""Folders of cameras and their images: after the global optimisation, as ARKit tracked, or both
mixed where people copied a part."""


def recognises(path: Path) -> bool:
    """Whether the folder holds key frames, or is the folder of them."""
    return _keyframes(path) is not None


def read(path: Path) -> Capture:
    """Read key frames; see `deltas_nets.captures.opening.Reader` for the contract."""
    both = _keyframes(path)
    if both is None:
        raise UserError("there are no cameras in keyframes", path, _REMEDY)
    cameras, images = both
    folder = cameras.parent
    if not images.is_dir():
        what = f"the raw data has {cameras.name} and no folder of their images"
        raise UserError(what, images, f"copy it from the export, or {_REMEDY}")
    doubts = []
    if cameras.name == "cameras":
        doubts.append(f"poses are as tracked, not optimised (no corrected_cameras), {folder}")
    elif images.name == "images":
        doubt = "corrected_images is missing: images are taken, whose lens is not undone"
        doubts.append(f"{doubt}, {folder}")
    found = Collected(images)
    files = sorted(listed(cameras, ".json"))
    for file in files:
        id = file.stem
        image = next(
            (
                image
                for suffix in (".jpg", ".jpeg", ".png")
                if (image := images / f"{id}{suffix}").is_file()
            ),
            None,
        )
        photo = found.photo(id, image)
        if photo is None:
            continue
        content = read_json(file, name="camera", remedy=_REMEDY, limit=_JSON_LIMIT)
        fields = Fields(content, file, where="the camera", remedy=_REMEDY)
        height, width = photo.size
        stated = int(fields.number("height", height)), int(fields.number("width", width))
        depth = folder / "depth" / f"{id}.png"
        found.add(
            photo,
            _pose(fields, id, file),
            _K(fields),
            stated=stated,
            depth=depth if depth.is_file() else None,
        )
    return found.capture(path, "Polycam", metric=True, doubts=doubts, form=FileForm(True, CORNER))


def _keyframes(path: Path) -> tuple[Path, Path] | None:
    """The folders of cameras and of images, optimised ones first.

    Of a folder of Polycam's name, which holds nothing else, cameras are told without images, too.
    """
    found = [
        (folder / cameras, folder / images)
        for folder in (path / "keyframes", path)
        for cameras, images in _KINDS
        if (folder / cameras).is_dir() and any(listed(folder / cameras, ".json"))
    ]
    whole = [both for both in found if both[1].is_dir()]
    own = [both for both in found if both[0].parent.name == "keyframes"]
    return next(iter(whole + own), None)


def _K(fields: Fields) -> FloatArray:
    """ARKit measures the principal point from the corner of the image."""
    fx, fy, cx, cy = (fields.number(name) for name in ("fx", "fy", "cx", "cy"))
    return camera_matrix(fx, fy, cx - CORNER, cy - CORNER, path=fields.path)


def _pose(fields: Fields, id: str, path: Path) -> FloatArray | Lost:
    world_from_cam = np.eye(4)
    for row in range(3):
        for column in range(4):
            world_from_cam[row, column] = fields.numbers(f"t_{row}{column}", (), finite=False)
    return cam_from_world_of(world_from_cam * OPENGL, id=id, path=path)
