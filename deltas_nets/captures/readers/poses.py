"""Poses as files state them, and what is lost: what readers of many formats have in common."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from deltas_nets.captures.capture import Lost
from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.ids import ids_in_words
from deltas_nets.captures.readers.rigid import why_not_rigid
from deltas_nets.captures.rigid import rigid, rigid_inverse
from deltas_nets.captures.rotations import rotations_of
from deltas_nets.errors import UserError

__all__ = [
    "OPENGL",
    "cam_from_world",
    "cam_from_world_of",
    "missing_images",
    "rotation_of_vector",
    "world_from_cam_inverse",
]

OPENGL = np.array([1.0, -1, -1, 1])
"""What the columns of a camera-to-world matrix are multiplied by where the camera's y points up and
it looks along -z."""


def cam_from_world(matrix: FloatArray, *, id: str, path: Path) -> FloatArray | Lost:
    """A pose that a file states as world-to-camera, or why it is none.

    Args:
        matrix: ``(3 or 4, 4)``, rounded by printing as it may be.
        id: of the frame, for errors.
        path: the file it came from.

    Returns:
        ``(4, 4)``, read-only, whose rotation is orthogonal to float64 precision.
    """
    if not np.isfinite(matrix).all():
        what = f"the pose of frame {id} is not finite"
        remedy = "repair it or take the frame out of the view sets"
        return Lost("no pose", UserError(what, path, remedy))
    why = why_not_rigid(matrix)
    if why is not None:
        what = f"the pose of frame {id} {why.what}"
        return Lost("not rigid", UserError(what, path, why.remedy))
    pose = _nearest_rigid(matrix)
    pose.setflags(write=False)
    return pose


def cam_from_world_of(world_from_cam: FloatArray, *, id: str, path: Path) -> FloatArray | Lost:
    """A pose that a file states as camera-to-world; see `cam_from_world`."""
    pose = cam_from_world(world_from_cam, id=id, path=path)
    if isinstance(pose, Lost):
        return pose
    inverse = rigid_inverse(pose)
    inverse.setflags(write=False)
    return inverse


def world_from_cam_inverse(world_from_cam: FloatArray, *, path: Path) -> FloatArray:
    """The rigid inverse of a finite pose, rounded by printing as it may be.

    Args:
        world_from_cam: ``(4, 4)``.
        path: the file it came from, for the error.

    Returns:
        ``(4, 4)``, read-only, whose rotation is orthogonal to float64 precision.

    Raises:
        UserError: the matrix is not a rotation and a translation.
    """
    why = why_not_rigid(world_from_cam)
    if why is not None:
        raise UserError(f"the pose {why.what}", path, why.remedy)
    inverse = rigid_inverse(_nearest_rigid(world_from_cam))
    inverse.setflags(write=False)
    return inverse


def _nearest_rigid(matrix: FloatArray) -> FloatArray:
    """The nearest rotation, else R^T is not the inverse of R and the rounding of the file stays."""
    left, _, right = np.linalg.svd(matrix[:3, :3])
    return rigid(left @ right, matrix[:3, 3])


def rotation_of_vector(vector: FloatArray) -> FloatArray:
    """The rotation by a vector's length, in radians, about its direction: ``(3,)`` to ``(3, 3)``.

    NaN where the vector is not finite.
    """
    with np.errstate(all="ignore"):
        angle = np.sqrt((vector * vector).sum())
        part = np.sin(angle / 2) / angle if angle > 1e-12 else 0.5
        return rotations_of(np.array([np.cos(angle / 2), *(part * vector)]))


def missing_images(ids: Sequence[str], path: Path) -> dict[str, Lost]:
    """Frames whose images are not there, all with one error.

    Args:
        ids: of the frames.
        path: the file that names them, or the folder where they should be.
    """
    if not ids:
        return {}
    what = f"there is no image of {len(ids)} of the frames ({ids_in_words(ids)})"
    error = UserError(what, path, "put the images beside it, or leave those frames out")
    return dict.fromkeys(ids, Lost("no image", error))
