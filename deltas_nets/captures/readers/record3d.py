"""Record3D's EXR export: metadata.json beside the folders rgb and depth."""

from pathlib import Path

import numpy as np

from deltas_nets.captures.capture import Capture, Lost
from deltas_nets.captures.file_form import FileForm
from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.readers.cameras import CORNER, camera_matrix
from deltas_nets.captures.readers.collected import Collected
from deltas_nets.captures.readers.json_file import Fields, read_json
from deltas_nets.captures.readers.numbered import numbered_files
from deltas_nets.captures.readers.poses import OPENGL, cam_from_world_of
from deltas_nets.captures.rigid import rigid
from deltas_nets.captures.rotations import rotations_of
from deltas_nets.errors import UserError

__all__ = ["read", "recognises"]

_REMEDY = "export the recording from Record3D again, as EXR and JPEG sequence"


def recognises(path: Path) -> bool:
    """Whether the folder, or the one that Record3D makes inside of it, is such an export."""
    return _folder(path) is not None


def read(path: Path) -> Capture:
    """Read an export; see `deltas_nets.captures.opening.Reader` for the contract."""
    folder = _folder(path)
    if folder is None:
        raise UserError("there is no metadata.json beside rgb", path, _REMEDY)
    file = folder / "metadata.json"
    if not file.is_file():
        file = folder.parent / "metadata.json"
    fields = Fields(
        read_json(file, name="metadata", remedy=_REMEDY), file, where="the file", remedy=_REMEDY
    )
    stated = int(fields.number("h")), int(fields.number("w"))
    poses = fields.numbers("poses", (-1, 7), finite=False)
    of_each = _intrinsics(fields, len(poses))
    images = numbered_files(folder / "rgb", (".jpg", ".jpeg", ".png"))
    depths = numbered_files(folder / "depth", (".exr",))
    found = Collected(folder / "rgb")
    for number in range(len(poses)):
        id = str(number)
        photo = found.photo(id, images.get(number))
        if photo is not None:
            pose = _pose(poses[number], id, file)
            K = camera_matrix(*of_each[number].tolist(), path=file)
            found.add(photo, pose, K, stated=stated, depth=depths.get(number))
    doubts = []
    without = len(images.keys() - set(range(len(poses))))
    if without:
        doubts.append(f"{without} of {len(images)} images have no pose and are left out, {file}")
    return found.capture(
        folder, "Record3D EXR", metric=True, doubts=doubts, form=FileForm(True, CORNER)
    )


def _folder(path: Path) -> Path | None:
    for folder in (path, path / "EXR_RGBD"):
        there = (folder / "metadata.json").is_file() or (path / "metadata.json").is_file()
        if there and (folder / "rgb").is_dir():
            return folder
    return None


def _intrinsics(fields: Fields, num_frames: int) -> FloatArray:
    """``(F, 4)`` fx fy cx cy; newer exports state them for each frame.

    ARKit measures the principal point from the corner of the image.
    """
    if "perFrameIntrinsicCoeffs" in fields:
        numbers = fields.numbers("perFrameIntrinsicCoeffs", (-1, 4))
        if len(numbers) != num_frames:
            raise fields.error(f"has {num_frames} poses and {len(numbers)} intrinsics")
        return numbers - (0, 0, CORNER, CORNER)
    by_column = fields.numbers("K", (9,))
    fx, fy, cx, cy = by_column[[0, 4, 6, 7]]
    if not cx and not cy:
        raise fields.error("has a K by rows, not column by column")
    return np.tile((fx, fy, cx - CORNER, cy - CORNER), (num_frames, 1))


def _pose(numbers: FloatArray, id: str, path: Path) -> FloatArray | Lost:
    rotation = rotations_of(numbers[[3, 0, 1, 2]])
    return cam_from_world_of(rigid(rotation, numbers[4:]) * OPENGL, id=id, path=path)
