"""What our own format may say: keys of the root, of cameras and of frames."""

import difflib
from collections.abc import Iterable

from deltas_nets.captures.readers.json_file import Fields
from deltas_nets.errors import UserError

__all__ = [
    "CAMERA",
    "DEPTH_CAMERA",
    "FRAME",
    "MEANT",
    "REMEDY",
    "ROOT",
    "VERSION",
    "check_keys",
]

VERSION = 1
REMEDY = "see docs/captures.md for what it may hold"

CAMERA = ("fx", "fy", "cx", "cy", "width", "height", "lens", "coefficients")
"""Keys of a camera: at the root, in ``cameras``, or in a frame."""
DEPTH_CAMERA = ("fx", "fy", "cx", "cy", "width", "height", "cam_from_depth")
"""Keys of the camera of depth, where that is not the colour camera."""
FRAME = (
    *("id", "image", "cam_from_world", "world_from_cam", "camera", *CAMERA),
    *("depth", "depth_scale", "depth_camera", "depth_range", "sources"),
)
ROOT = (
    *("version", "units", "pixel_centres", *CAMERA, "cameras", "frames"),
    *("depth_scale", "depth_camera", "depth_range", "points", "observations"),
)
MEANT = {
    "k": "fx, fy, cx, cy",
    "intrinsics": "fx, fy, cx, cy",
    "intrinsic": "fx, fy, cx, cy",
    "camera_matrix": "fx, fy, cx, cy",
    "camera_intrinsics": "fx, fy, cx, cy",
    "file": "image",
    "filename": "image",
    "file_name": "image",
    "file_path": "image",
    "path": "image",
    "name": "image",
    "rgb": "image",
    "pose": "world_from_cam (camera-to-world) or cam_from_world",
    "extrinsics": "cam_from_world",
    "extrinsic": "cam_from_world",
    "transform_matrix": "world_from_cam, with axes x right, y down, z forward",
    "c2w": "world_from_cam",
    "w2c": "cam_from_world",
    "unit": "units",
    "scale": "units, or --scale of the command",
    "distortion": "lens and coefficients",
    "camera_model": "lens",
    "dist_coeffs": "lens and coefficients",
    "w": "width",
    "h": "height",
    "fl_x": "fx",
    "fl_y": "fy",
}
"""What keys of other programs are called here."""
PARTS = (
    *("rotation", "rotation_matrix", "r", "rvec", "quaternion", "quat", "q", "orientation"),
    *("euler", "euler_angles", "translation", "position", "location", "t", "tvec"),
    *("qw", "qx", "qy", "qz", "tx", "ty", "tz"),
)
"""Keys of a part of a pose, of which here is one matrix."""


def check_keys(fields: Fields, known: Iterable[str]) -> None:
    """Refuse keys that nobody would read.

    Raises:
        UserError: there is one; the nearest known key is named.
    """
    wrong = next((key for key in fields.values if key not in known), None)
    if wrong is None:
        return
    near = difflib.get_close_matches(wrong.lower(), known, n=1, cutoff=0.6)
    meant = MEANT.get(wrong.lower()) or (near[0] if near else None)
    if wrong.lower() in PARTS and "world_from_cam" in known:
        meant = "world_from_cam, a 4x4 of the rotation as a matrix and of where the camera is"
    remedy = f"did you mean {meant}?" if meant else f"known are {', '.join(known)}"
    raise UserError(f"{fields.where} has an unknown key {wrong[:40]!r}", fields.path, remedy)
