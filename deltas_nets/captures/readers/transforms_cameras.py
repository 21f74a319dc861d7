"""Intrinsics in transforms.json: nerfstudio's and instant-ngp's names for them."""

import math
from typing import NamedTuple

import numpy as np

from deltas_nets.captures.frame import FloatArray, Lens
from deltas_nets.captures.readers.cameras import size_of
from deltas_nets.captures.readers.json_file import Fields

__all__ = ["INTRINSICS", "StatedCamera", "stated_camera"]

STRAIGHT = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
FISHEYE = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
PANORAMA = "EQUIRECTANGULAR"
BY_OTHER_NAMES = {"PERSPECTIVE": "OPENCV", "FISHEYE": "OPENCV_FISHEYE", "SPHERICAL": PANORAMA}
"""What programs besides nerfstudio call them; none is a model of another kind in COLMAP."""
COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")
"""In the order of nerfstudio's distortion_params."""
INTRINSICS = (
    "fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "k4", "p1", "p2", "camera_model",
    "camera_angle_x", "camera_angle_y", "is_fisheye", "distortion_params",
)  # fmt: skip
"""What may be at the root or in a frame."""
OTHER_WORDS = ("K", "intrinsics", "intrinsic_matrix", "camera_matrix", "fx", "focal_length")
"""Of other formats, whose pixels may be counted from elsewhere."""


class StatedCamera(NamedTuple):
    """A camera as a file states it.

    Attributes:
        focal: ``(2,)`` px; angles of view in radians where ``of_angles`` is True.
        of_angles: whether the focal lengths follow from the size and angles.
        centre: principal point, the corner at (0, 0); None for the middle.
        lens: None where straight lines are straight.
        size: (height, width) in the file's words; None for the image's.
    """

    focal: tuple[float, float]
    of_angles: bool
    centre: tuple[float, float] | None
    lens: Lens | None
    size: tuple[int, int] | None

    def K(self, image_size: tuple[int, int]) -> FloatArray:
        """``(3, 3)`` with pixel centres at integers, for the stated size or, without, this one."""
        height, width = self.size or image_size
        cx, cy = self.centre or (width / 2, height / 2)
        fx, fy = self.focal
        if self.lens is not None and self.lens.model == PANORAMA:
            fx, fy, cx, cy = width / (2 * math.pi), height / math.pi, width / 2, height / 2
        elif self.of_angles:
            fx = width / 2 / math.tan(self.focal[0] / 2)
            fy = height / 2 / math.tan(self.focal[1] / 2) if self.focal[1] else fx
        return np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1.0]])


def stated_camera(root: Fields, frame: Fields) -> StatedCamera:
    """The camera of a frame; what the frame says goes before what the root says.

    Raises:
        UserError: there is no focal length, a number is none, or the lens is not known.
    """
    both = Fields.merged((root, frame), (*INTRINSICS, *OTHER_WORDS))
    lens = _lens(both)
    focal, of_angles = _focal(frame, both, lens)
    centre = (both.number("cx"), both.number("cy")) if "cx" in both and "cy" in both else None
    size = size_of(both, "h", "w") if "h" in both and "w" in both else None
    return StatedCamera(focal, of_angles, centre, lens, size)


def _focal(frame: Fields, both: Fields, lens: Lens | None) -> tuple[tuple[float, float], bool]:
    if lens is not None and lens.model == PANORAMA:
        return (0.0, 0.0), True
    angles_of_frame = "camera_angle_x" in frame and "fl_x" not in frame
    if "fl_x" in both and not angles_of_frame:
        focal = both.number("fl_x")
        both_focal = focal, both.number("fl_y", focal)
        if min(both_focal) <= 0:
            raise both.error(f"has focal lengths that are not positive ({focal:g})", "fl_x")
        return both_focal, False
    if "camera_angle_x" not in both:
        other = next((f" but {word}" for word in OTHER_WORDS if word in both), "")
        written = "; write fl_x, fl_y, cx, cy" if other else ""
        raise both.error(f"has no focal length (fl_x or camera_angle_x){other}{written}")
    angles = both.number("camera_angle_x"), both.number("camera_angle_y", 0.0)
    if not (0 < angles[0] < math.pi and 0 <= angles[1] < math.pi):
        key = "camera_angle_x" if not 0 < angles[0] < math.pi else "camera_angle_y"
        angle = both.number(key)
        degrees = f" (degrees? say {math.radians(angle):.6g})" if math.pi <= angle < 180 else ""
        raise both.error(f"has a {key} of {angle:g}, not between 0 and pi{degrees}", key)
    return angles, True


def _lens(both: Fields) -> Lens | None:
    k1, k2, k3, k4, p1, p2 = _coefficients(both)
    stated = both.text("camera_model", "").strip()
    plain = stated.upper().replace("-", "_").replace(" ", "_")
    model = BY_OTHER_NAMES.get(plain, plain)
    if not model:
        model = "OPENCV_FISHEYE" if both.truth("is_fisheye") else "OPENCV"
    if model in FISHEYE:
        return Lens("OPENCV_FISHEYE", (k1, k2, k3, k4))
    if model == PANORAMA:
        return Lens(PANORAMA, ())
    if model not in STRAIGHT:
        known = ", ".join((*STRAIGHT, *FISHEYE, PANORAMA))
        raise both.error(
            f"has a camera_model that is not read, {stated[:40]} (read are {known})", "camera_model"
        )
    if k4:
        raise both.error(f"has a k4 of {k4:g}, which only fisheye lenses have", "k4")
    if k3:
        return Lens("FULL_OPENCV", (k1, k2, p1, p2, k3, 0.0, 0.0, 0.0))
    return Lens("OPENCV", (k1, k2, p1, p2)) if any((k1, k2, p1, p2)) else None


def _coefficients(both: Fields) -> list[float]:
    """k1, k2, k3, k4, p1, p2; a list of them goes before single ones, as in nerfstudio."""
    if "distortion_params" not in both:
        return [both.number(name, 0.0) for name in COEFFICIENTS]
    listed = both.numbers("distortion_params", (-1,)).tolist()
    if len(listed) != len(COEFFICIENTS):
        what = f"has distortion_params of {len(listed)} numbers, not {' '.join(COEFFICIENTS)}"
        raise both.error(what, "distortion_params")
    return list(listed)
