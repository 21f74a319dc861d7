"""kapture: sensors, records_camera and trajectories in the folder sensors."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import NamedTuple

import numpy as np

from deltas_geom.cameras.lenses.models import MODELS
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.file_form import FileForm
from deltas_nets.captures.frame import FloatArray, Lens
from deltas_nets.captures.points import Observations, SparsePoints
from deltas_nets.captures.readers.cameras import CORNER, camera_matrix
from deltas_nets.captures.readers.collected import Collected
from deltas_nets.captures.readers.files import FileFinder
from deltas_nets.captures.readers.names import frame_ids
from deltas_nets.captures.readers.poses import cam_from_world
from deltas_nets.captures.rigid import rigid
from deltas_nets.captures.rotations import rotations_of
from deltas_nets.captures.text_lines import read_text
from deltas_nets.errors import UserError

__all__ = ["read", "recognises"]

_REMEDY = "write it as kapture 1.1 does: values between commas"
_STRAIGHT = "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"
"""Models that bend nothing where their coefficients are 0."""
MOST_RIGS = 8
"""That a sensor is on. All are tried for each of its images."""


class _Sensor(NamedTuple):
    size: tuple[int, int]
    K: FloatArray
    lens: Lens | None


class _Pose(NamedTuple):
    """Device from world, or sensor from rig: qw qx qy qz tx ty tz."""

    numbers: tuple[float, ...]

    @property
    def matrix(self) -> FloatArray:
        quaternion, translation = np.split(np.array(self.numbers), (4,))
        return rigid(rotations_of(quaternion), translation)


def recognises(path: Path) -> bool:
    """Whether the folder, or the mapping part of it, has kapture's tables."""
    return _folder(path) is not None


def read(path: Path) -> Capture:
    """Read cameras and poses; see `deltas_nets.captures.opening.Reader` for the contract."""
    path = _folder(path) or path
    folder = path / "sensors"
    sensors = _sensors(folder / "sensors.txt")
    poses = _poses(folder / "trajectories.txt")
    rigs = _rigs(folder / "rigs.txt")
    records = folder / "records_camera.txt"
    rows = list(_rows(records, 3))
    names = [words[2] for _, words in rows]
    ids = frame_ids(names, records)
    finder = FileFinder(path, (folder / "records_data",), names=names)
    found = Collected(records)
    for id, (number, (stamp, device, name, *_)) in zip(ids, rows, strict=True):
        if device not in sensors:
            what = (
                f"line {number} is of the sensor {device[:40]!r}, which is no camera that is read"
            )
            raise UserError(what, records, "calibrate it: sensors.txt takes models of COLMAP's")
        photo = found.photo(id, finder.find(name))
        if photo is None:
            continue
        matrix = _cam_from_world(stamp, device, poses, rigs)
        if matrix is None:
            what = f"frame {id} has no pose"
            remedy = "add it to the trajectories, or take the frame out of the view sets"
            found.without_pose(id, UserError(what, folder / "trajectories.txt", remedy))
            continue
        pose = cam_from_world(matrix, id=id, path=folder / "trajectories.txt")
        sensor = sensors[device]
        found.add(photo, pose, sensor.K, stated=sensor.size, lens=sensor.lens)
    capture = found.capture(
        path, "kapture", metric=False, doubts=finder.doubts(), form=FileForm(centre=CORNER)
    )
    return replace(capture, points=_points(path / "reconstruction" / "points3d.txt"))


def _folder(path: Path) -> Path | None:
    for folder in (path, path / "mapping"):
        tables = folder / "sensors"
        if (tables / "sensors.txt").is_file() or (tables / "records_camera.txt").is_file():
            return folder
    return None


def _rows(path: Path, least: int) -> Iterator[tuple[int, list[str]]]:
    """Numbers and values of the lines."""
    text = read_text(path, name="table", remedy=_REMEDY)
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        words = [word.strip() for word in line.split(",")]
        if len(words) < least:
            what = f"line {number} has {len(words)} values, fewer than {least}"
            raise UserError(what, path, _REMEDY)
        yield number, words


def _numbers(words: Sequence[str], line: int, path: Path) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError as error:
        what = f"line {line} holds {', '.join(words)[:40]!r} where numbers should be"
        raise UserError(what, path, _REMEDY) from error


def _sensors(path: Path) -> Mapping[str, _Sensor]:
    """Cameras by id. Models are COLMAP's, and as there the corner of an image is at 0."""
    sensors = {}
    for line, words in _rows(path, 3):
        if words[2].lower() != "camera":
            continue
        model = words[3].upper() if len(words) > 3 else ""
        if model not in MODELS or model == "EQUIRECTANGULAR":
            continue
        numbers = _numbers(words[4:], line, path)
        focals, bends = MODELS[model].focals, len(MODELS[model].coefficients)
        if len(numbers) != 4 + focals + bends:
            what = f"line {line} has {len(numbers)} numbers, not the {4 + focals + bends}"
            raise UserError(f"{what} of {model}", path, _REMEDY)
        if not np.isfinite(numbers).all() or not all(0 < side < 2**31 for side in numbers[:2]):
            raise UserError(f"line {line} is no camera", path, _REMEDY)
        fx, fy = numbers[2], numbers[1 + focals]
        cx, cy = numbers[2 + focals : 4 + focals]
        coefficients = tuple(numbers[4 + focals :])
        straight = not any(coefficients) and model in _STRAIGHT
        sensors[words[0]] = _Sensor(
            (int(numbers[1]), int(numbers[0])),
            camera_matrix(fx, fy, cx - CORNER, cy - CORNER, path=path),
            None if straight else Lens(model, coefficients),
        )
    return sensors


def _poses(path: Path) -> Mapping[tuple[str, str], _Pose]:
    """Device from world, by time and device."""
    if not path.is_file():
        raise UserError("there are no trajectories", path, "localise the images first")
    return {(words[0], words[1]): _pose(words[2:], line, path) for line, words in _rows(path, 9)}


def _rigs(path: Path) -> Mapping[str, Sequence[tuple[str, _Pose]]]:
    """The rigs that a sensor is on, and where: sensor from rig."""
    rigs: dict[str, list[tuple[str, _Pose]]] = {}
    if path.is_file():
        for line, words in _rows(path, 9):
            of_sensor = rigs.setdefault(words[1], [])
            of_sensor.append((words[0], _pose(words[2:], line, path)))
            if len(of_sensor) > MOST_RIGS:
                what = f"the sensor {words[1][:40]!r} is on more than {MOST_RIGS} rigs"
                raise UserError(what, path, _REMEDY)
    return rigs


def _pose(words: Sequence[str], line: int, path: Path) -> _Pose:
    """A pose may be partial: what is empty is not known."""
    if any(word == "" for word in words[:7]):
        return _Pose((np.nan,) * 7)
    return _Pose(tuple(_numbers(words[:7], line, path)))


def _cam_from_world(
    stamp: str,
    device: str,
    poses: Mapping[tuple[str, str], _Pose],
    rigs: Mapping[str, Sequence[tuple[str, _Pose]]],
    deepest: int = 2,
) -> FloatArray | None:
    """A sensor's pose of its own, or that of a rig it is on; rigs may be on rigs."""
    if (stamp, device) in poses:
        return poses[stamp, device].matrix
    for rig, sensor_from_rig in rigs.get(device, ()) if deepest else ():
        rig_from_world = _cam_from_world(stamp, rig, poses, rigs, deepest - 1)
        if rig_from_world is not None:
            with np.errstate(invalid="ignore", over="ignore"):
                return sensor_from_rig.matrix @ rig_from_world
    return None


def _points(path: Path) -> SparsePoints | None:
    """Points without their observations, whose pixels kapture keeps in binary files of features."""
    if not path.is_file():
        return None
    table = _table(path)
    table = table[np.isfinite(table).all(axis=1)]
    if not len(table):
        return None
    rgb = table[:, 3:].clip(0, 255).astype(np.uint8)
    return SparsePoints(table[:, :3], rgb, np.full(len(table), np.nan), Observations.none())


def _table(path: Path) -> FloatArray:
    """``(P, 6)``."""
    text = read_text(path, name="table", remedy=_REMEDY)
    try:
        with warnings.catch_warnings(action="ignore"):
            table = np.loadtxt(StringIO(text), comments="#", delimiter=",", ndmin=2)
        if table.size == 0 or table.shape[1] == 6:
            return table.reshape(-1, 6)
    except ValueError:
        pass
    # A line that is malformed, which this names, or has more values.
    rows = [_numbers(words[:6], line, path) for line, words in _rows(path, 6)]
    return np.array(rows, dtype=np.float64).reshape(-1, 6)
