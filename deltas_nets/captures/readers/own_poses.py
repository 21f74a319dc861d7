"""Poses in our own format: 4x4, 3x4, or their numbers row by row."""

import numpy as np

from deltas_nets.captures.capture import Lost
from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.readers.json_file import Fields
from deltas_nets.captures.readers.poses import world_from_cam_inverse
from deltas_nets.captures.rigid import rigid_inverse
from deltas_nets.errors import UserError

__all__ = ["matrix_of", "pose_of"]

REMEDY_OF_PARTS = (
    "write the rotation as a matrix, beside it where the camera is: 4 rows of 4 numbers"
)


def pose_of(frame: Fields) -> FloatArray | Lost:
    """``(4, 4)`` cam_from_world, or why there is none."""
    keys = [key for key in ("cam_from_world", "world_from_cam") if key in frame]
    if not keys:
        return Lost("no pose", frame.error("has no pose (cam_from_world or world_from_cam)"))
    try:
        if len(keys) > 1:
            raise frame.error("has both cam_from_world and world_from_cam")
        matrix = matrix_of(frame, keys[0])
    except UserError as error:
        return Lost("malformed", error)
    if not np.isfinite(matrix).all():
        return Lost("no pose", frame.error(f"has a {keys[0]} that is not finite"))
    try:
        inverse = world_from_cam_inverse(matrix, path=frame.path)
        # Twice, so that what was printed with few digits becomes a rotation.
        return inverse if keys[0] == "world_from_cam" else rigid_inverse(inverse)
    except UserError as error:
        what = f"{frame.where}: {error.what}"
        return Lost("not rigid", UserError(what, frame.path, error.remedy))


def matrix_of(frame: Fields, key: str) -> FloatArray:
    """``(4, 4)`` of 4x4, 3x4, 16 or 12 numbers."""
    rows = frame.values[key]
    if isinstance(rows, list) and len(rows) in (12, 16):
        flat = frame.numbers(key, (len(rows),), finite=False).reshape(-1, 4)
    elif isinstance(rows, list) and not any(isinstance(row, list) for row in rows):
        what = f"{frame.where} has a {key} of {len(rows)} numbers, not 12 or 16"
        raise UserError(what, frame.path, REMEDY_OF_PARTS if len(rows) in (6, 7) else frame.remedy)
    else:
        count = 3 if isinstance(rows, list) and len(rows) == 3 else 4
        flat = frame.numbers(key, (count, 4), finite=False)
    matrix = np.eye(4)
    matrix[: len(flat)] = flat
    return matrix
