"""3D Scanner App (Laan Labs), "All Data": frame_00000.jpg, its camera in a JSON file, and depth."""

from pathlib import Path

import numpy as np

from deltas_nets.captures.capture import Capture, Lost
from deltas_nets.captures.file_form import FileForm
from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.readers.cameras import CORNER, camera_of_matrix
from deltas_nets.captures.readers.collected import Collected
from deltas_nets.captures.readers.json_file import Fields, read_json
from deltas_nets.captures.readers.numbered import numbered_files
from deltas_nets.captures.readers.poses import OPENGL, cam_from_world_of
from deltas_nets.errors import UserError

__all__ = ["read", "recognises"]

_REMEDY = "in 3D Scanner App share the scan again as All Data"
_JSON_LIMIT = 2**20
_ROUNDING = 1e-3
"""Of what is 0 or 1 in a matrix, as a tracker prints it."""


def recognises(path: Path) -> bool:
    """Whether cameras of frames lie in the folder."""
    return bool(numbered_files(path, (".json",), "frame_"))


def read(path: Path) -> Capture:
    """Read a scan; see `deltas_nets.captures.opening.Reader` for the contract."""
    cameras = numbered_files(path, (".json",), "frame_")
    images = numbered_files(path, (".jpg", ".jpeg", ".png"), "frame_")
    if not images:
        raise UserError("the scan has cameras and no image", path, _REMEDY)
    depths = numbered_files(path, (".png",), "depth_")
    found = Collected(path)
    for number, file in cameras.items():
        if number not in images:
            continue
        id = file.stem
        photo = found.photo(id, images[number])
        if photo is None:
            continue
        content = read_json(file, name="camera", remedy=_REMEDY, limit=_JSON_LIMIT)
        fields = Fields(content, file, where="the camera", remedy=_REMEDY)
        found.add(photo, _pose(fields, id), _K(fields), depth=depths.get(number))
    doubts = []
    without = len(images.keys() - cameras.keys())
    if without:
        doubts.append(f"{without} of {len(images)} images have no pose and are left out, {path}")
    return found.capture(
        path, "3D Scanner App", metric=True, doubts=doubts, form=FileForm(True, CORNER)
    )


def _K(fields: Fields) -> FloatArray:
    """ARKit measures the principal point from the corner of the image."""
    matrix = fields.numbers("intrinsics", (9,)).reshape(3, 3)
    if not np.allclose(matrix[2], (0, 0, 1), atol=_ROUNDING):
        raise fields.error("has intrinsics that are not by rows, with 0 0 1 as the last")
    return camera_of_matrix(matrix, path=fields.path, corner=CORNER)


def _pose(fields: Fields, id: str) -> FloatArray | Lost:
    world_from_cam = fields.numbers("cameraPoseARFrame", (16,), finite=False).reshape(4, 4)
    last = world_from_cam[3]
    if np.isfinite(world_from_cam).all() and not np.allclose(last, (0, 0, 0, 1), atol=_ROUNDING):
        raise fields.error("has a cameraPoseARFrame that is not by rows, with 0 0 0 1 as the last")
    return cam_from_world_of(world_from_cam * OPENGL, id=id, path=fields.path)
