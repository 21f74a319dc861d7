"""info.txt of BundleFusion, _info.txt of 3RScan and ScanNet's tools: the cameras of a sensor.

Each line is a key, "=" and its value; the keys are those of a .sens file's header.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.readers.cameras import camera_of_matrix
from deltas_nets.captures.text_lines import read_text
from deltas_nets.errors import UserError

__all__ = ["SensorInfo", "read_sensor_info"]

NAMES = ("_info.txt", "info.txt")
_REMEDY = "write camera-intrinsics.txt with the 3x3 matrix beside the images"
_COLOUR, _DEPTH = "m_calibrationColorIntrinsic", "m_calibrationDepthIntrinsic"
_PLACES = ("m_calibrationColorExtrinsic", "m_calibrationDepthExtrinsic")


class SensorInfo(NamedTuple):
    """The cameras as the file states them.

    Attributes:
        path: the file.
        K: ``(3, 3)`` of the colour camera.
        size: (height, width) that it is for; None for the images'.
        depth_K: ``(3, 3)`` of the depth camera; None where it is the colour camera.
        depth_scale: steps of depth in a metre; None where it is not stated.
        moved: whether one of the cameras stands aside.
    """

    path: Path
    K: FloatArray
    size: tuple[int, int] | None
    depth_K: FloatArray | None
    depth_scale: float | None
    moved: bool


def read_sensor_info(folder: Path) -> SensorInfo | None:
    """What the file of a folder says; None where there is no such file.

    Raises:
        UserError: it states no colour camera, or a number is none.
    """
    path = next((file for name in NAMES if (file := folder / name).is_file()), None)
    if path is None:
        return None
    lines = read_text(path, name="sensor's info", remedy=_REMEDY).splitlines()
    pairs = [line.partition("=") for line in lines if line.startswith("m_") and "=" in line]
    said = {key.strip(): value.split() for key, _, value in pairs}
    if not said:
        return None  # a text of another kind
    if _COLOUR not in said:
        raise UserError(f"the file states no {_COLOUR}", path, _REMEDY)
    places = [_matrix(said, key, path) for key in _PLACES if key in said]
    return SensorInfo(
        path,
        _camera(said, _COLOUR, path),
        _size(said, path),
        _camera(said, _DEPTH, path) if _DEPTH in said else None,
        _positive(said, "m_depthShift", path) if "m_depthShift" in said else None,
        # All zeros where the writer knew none.
        any(place.any() and np.abs(place - np.eye(4)).max() > 1e-3 for place in places),
    )


def _camera(said: Mapping[str, list[str]], key: str, path: Path) -> FloatArray:
    matrix = _matrix(said, key, path)
    return camera_of_matrix(matrix, path=path)


def _matrix(said: Mapping[str, list[str]], key: str, path: Path) -> FloatArray:
    numbers = _numbers(said, key, path)
    if len(numbers) != 16:
        raise UserError(f"{key} has {len(numbers)} numbers, not 16", path, _REMEDY)
    return np.array(numbers).reshape(4, 4)


def _size(said: Mapping[str, list[str]], path: Path) -> tuple[int, int] | None:
    keys = ("m_colorHeight", "m_colorWidth")
    if not all(key in said for key in keys):
        return None
    height, width = (int(_positive(said, key, path)) for key in keys)
    return height, width


def _positive(said: Mapping[str, list[str]], key: str, path: Path) -> float:
    numbers = _numbers(said, key, path)
    if len(numbers) != 1 or not 0 < numbers[0] < 2**31:
        raise UserError(f"{key} is no positive number", path, _REMEDY)
    return numbers[0]


def _numbers(said: Mapping[str, list[str]], key: str, path: Path) -> list[float]:
    try:
        return [float(word) for word in said[key]]
    except ValueError as error:
        raise UserError(f"{key} holds what is no number", path, _REMEDY) from error
