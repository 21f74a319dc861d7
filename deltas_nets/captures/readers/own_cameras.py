"""Cameras in our own format: where they may be stated, and what they may say."""

import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from deltas_nets.captures.colmap_model import CAMERA_MODELS
from deltas_nets.captures.frame import FloatArray, Lens
from deltas_nets.captures.readers.cameras import size_of
from deltas_nets.captures.readers.image_sizes import SizedCamera, at_size, first_size
from deltas_nets.captures.readers.json_file import Fields
from deltas_nets.captures.readers.own_poses import matrix_of
from deltas_nets.captures.readers.own_table import CAMERA, DEPTH_CAMERA, check_keys
from deltas_nets.captures.readers.poses import world_from_cam_inverse
from deltas_nets.captures.rigid import rigid_inverse
from deltas_nets.errors import UserError

__all__ = [
    "OwnCamera",
    "depth_camera",
    "named_cameras",
    "pixel_centre",
    "sized",
    "stated_camera",
]

CENTRES = {"integers": 0.0, "halves": 0.5}
"""Where the centre of the first pixel is, in the file's words."""


class OwnCamera(NamedTuple):
    """A camera as the file states it.

    Attributes:
        focal: fx and fy, px.
        centre: cx and cy, pixel centres at integers.
        lens: None where straight lines are straight.
        size: (height, width); None for the image's.
    """

    focal: tuple[float, float]
    centre: tuple[float, float]
    lens: Lens | None
    size: tuple[int, int] | None

    def K(self) -> FloatArray:
        """``(3, 3)`` at the stated size."""
        (fx, fy), (cx, cy) = self.focal, self.centre
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def named_cameras(root: Fields) -> dict[str, Fields]:
    """The cameras that frames name."""
    if "cameras" not in root:
        return {}
    cameras = root.inner("cameras")
    found = {name: cameras.inner(name) for name in cameras.values}
    for camera in found.values():
        check_keys(camera, CAMERA)
    return found


def stated_camera(root: Fields, frame: Fields, named: Mapping[str, Fields]) -> OwnCamera:
    """The camera of a frame: what it says itself, else its camera by name, else the root.

    Raises:
        UserError: it names a camera that there is not, or the camera lacks a number.
    """
    layers = [root]
    if "camera" in frame:
        name = frame.text("camera")
        if name not in named:
            near = difflib.get_close_matches(name, named, n=1)
            raise frame.error(
                f"is of a camera {name[:40]!r}, which is not in cameras"
                + (f" (did you mean {near[0]}?)" if near else "")
            )
        layers.append(named[name])
    return _camera(Fields.merged((*layers, frame), CAMERA), pixel_centre(root))


def pixel_centre(root: Fields) -> float:
    """Where the centre of the first pixel is in the file."""
    centres = root.text("pixel_centres", "integers")
    if centres not in CENTRES:
        raise root.error(f"has pixel_centres {centres[:20]!r}, neither {' nor '.join(CENTRES)}")
    return CENTRES[centres]


def _camera(values: Fields, offset: float) -> OwnCamera:
    fx, fy = values.number("fx"), values.number("fy")
    if min(fx, fy) <= 0:
        raise values.error(f"has focal lengths that are not positive ({fx:g} and {fy:g})", "fx")
    centre = values.number("cx") - offset, values.number("cy") - offset
    lens, says_size = _lens(values), "width" in values or "height" in values
    size = size_of(values, "height", "width") if says_size else None
    return OwnCamera((fx, fy), centre, lens, size)


def _lens(values: Fields) -> Lens | None:
    numbers = (
        tuple(values.numbers("coefficients", (-1,)).tolist()) if "coefficients" in values else ()
    )
    if "lens" not in values:
        if numbers:
            raise values.error("has coefficients, but no lens", "coefficients")
        return None
    name = values.text("lens")
    model = CAMERA_MODELS.get(name)
    if model is None:
        near = difflib.get_close_matches(name.upper(), CAMERA_MODELS, n=1, cutoff=0.4)
        what = f"{values.where_of('lens')} has an unknown lens {name[:40]!r}"
        remedy = f"did you mean {near[0]}?" if near else f"known are {', '.join(CAMERA_MODELS)}"
        raise UserError(what, values.path, remedy)
    if len(numbers) != model.num_coefficients:
        count = model.num_coefficients
        raise values.error(f"has {len(numbers)} coefficients; {name} has {count}", "coefficients")
    return None if model.straight and not any(numbers) else Lens(name, numbers)


def depth_camera(
    root: Fields, frame: Fields
) -> tuple[FloatArray, tuple[int, int] | None, FloatArray | None] | None:
    """K, size and place of the depth camera; None where it is the colour camera.

    Raises:
        UserError: a number is missing or is none, or its place is not rigid.
    """
    said = next((fields for fields in (frame, root) if "depth_camera" in fields), None)
    if said is None:
        return None
    values = said.inner("depth_camera")
    check_keys(values, DEPTH_CAMERA)
    camera = _camera(values, pixel_centre(root))
    if "cam_from_depth" not in values:
        return camera.K(), camera.size, None
    try:
        place = matrix_of(values, "cam_from_depth")
        inverse = world_from_cam_inverse(place, path=values.path)
    except UserError as error:
        raise UserError(f"{values.where}: {error.what}", values.path, error.remedy) from error
    return camera.K(), camera.size, rigid_inverse(inverse)


def sized(cameras: Mapping[OwnCamera, list[Path]], fallback: Path) -> dict[OwnCamera, SizedCamera]:
    """Every camera at the size of its images.

    Args:
        cameras: the images of each.
        fallback: what to name where none of them can be read.
    """
    found = {}
    for camera, images in cameras.items():
        image, size = first_size(images) or (fallback, camera.size or (1, 1))
        stated = camera.size or size
        found[camera] = at_size(camera.K(), camera.lens, stated=stated, size=size, image=image)
    return found
