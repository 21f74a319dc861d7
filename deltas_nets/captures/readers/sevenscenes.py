"""7-Scenes and its relatives: frame-000000.color.png, .depth.png and .pose.txt in one folder.

In 7-Scenes, colour and depth are two cameras, the poses are those of the depth camera, and nothing
is registered. 3DMatch and others took the layout over for depth that is registered to colour: they
state intrinsics of their own.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from deltas_nets.captures.capture import Capture, Lost
from deltas_nets.captures.frame import FloatArray, Frame
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.images import image_size_of, in_words
from deltas_nets.captures.readers.cameras import camera_matrix
from deltas_nets.captures.readers.intrinsics import read_intrinsics
from deltas_nets.captures.readers.numbered import numbered_files
from deltas_nets.captures.readers.poses import cam_from_world_of, missing_images
from deltas_nets.captures.text_lines import read_numbers
from deltas_nets.errors import UserError

__all__ = ["read", "recognises"]

COLOUR_FOCAL, DEPTH_FOCAL = 525.0, 585.0
"""Of the sensor's two cameras at 640x480, principal point (320, 240); the data set states the
second and no calibration of the first, for which 525 is what the maker says."""
ASIDE = 0.025
"""Metres that the colour camera stands to the right of the depth camera. Measured on a sequence as
published: edges of depth fall onto edges of colour with this offset, not with none or the other
sign, and matches lie nearer to their epipolar lines."""
SIZE = 480, 640

_REMEDY = "write 4 rows of 4 numbers (camera-to-world), or remove the file and its image"


class _Sensor(NamedTuple):
    """K of both cameras, and where the depth camera stands; None where they are one."""

    K: FloatArray
    depth_K: FloatArray | None
    cam_from_depth: FloatArray | None


def recognises(path: Path) -> bool:
    """Whether the folder is a sequence, or holds sequences."""
    return bool(_sequences(path))


def read(path: Path) -> Capture:
    """Read all sequences; see `deltas_nets.captures.opening.Reader` for the contract."""
    frames: list[Frame] = []
    lost: dict[str, Lost] = {}
    sequences = _sequences(path)
    files = {name: _colour(folder) for name, folder in sequences.items()}
    sizes = (image_size_of(file) for images in files.values() for file in images.values())
    image_size = next((size for size in sizes if size is not None), None)
    if image_size is None:
        raise UserError("no image frame-000000.color.png can be decoded", path, "copy them again")
    sensor = _sensor(path, sequences, image_size)
    for name, folder in sequences.items():
        _read_sequence(name, folder, files[name], image_size, sensor, frames, lost)
    doubts = []
    if sensor.cam_from_depth is not None and any(frame.depth_path for frame in frames):
        doubts.append(
            "depth is of another camera, 25 mm aside, and is not registered to the colour images "
            f"(7-Scenes as published), {path}: register it before it is compared with anything"
        )
    return Capture(path, Frames.of(frames, path), lost, tuple(doubts), "7-Scenes", metric=True)


def _read_sequence(
    name: str,
    folder: Path,
    images: Mapping[int, Path],
    image_size: tuple[int, int],
    sensor: _Sensor,
    frames: list[Frame],
    lost: dict[str, Lost],
) -> None:
    poses = numbered_files(folder, (".pose.txt",), "frame-")
    depths = numbered_files(folder, (".depth.png",), "frame-")
    missing = []
    for number in sorted(images.keys() | poses.keys()):
        id = f"{name}{number:06d}"
        if number not in images:
            missing.append(id)
            continue
        pose = _pose(poses.get(number), id, folder, sensor)
        if isinstance(pose, Lost):
            lost[id] = pose
            continue
        depth = depths.get(number)
        frames.append(
            Frame(
                id=id,
                image_path=images[number],
                image_size=image_size,
                K=sensor.K,
                cam_from_world=pose,
                depth_path=depth,
                depth_K=None if depth is None else sensor.depth_K,
                depth_size=None if depth is None or sensor.depth_K is None else SIZE,
                cam_from_depth=None if depth is None else sensor.cam_from_depth,
            )
        )
    lost |= missing_images(missing, folder)


def _pose(path: Path | None, id: str, folder: Path, sensor: _Sensor) -> FloatArray | Lost:
    if path is None:
        what = f"frame {id} has no pose file"
        return Lost("no pose", UserError(what, folder, "take it out of the view sets"))
    try:
        numbers = read_numbers(path, name="pose", remedy=_REMEDY)
    except UserError as error:
        return Lost("malformed", error)
    if len(numbers) != 16:
        what = f"the pose file has {len(numbers)} numbers, not 16"
        return Lost("malformed", UserError(what, path, _REMEDY))
    pose = cam_from_world_of(np.array(numbers).reshape(4, 4), id=id, path=path)
    if isinstance(pose, Lost) or sensor.cam_from_depth is None:
        return pose
    return sensor.cam_from_depth @ pose


def _sensor(path: Path, sequences: Mapping[str, Path], image_size: tuple[int, int]) -> _Sensor:
    places = {path, path.parent, *sequences.values()}
    stated = next(
        (
            file
            for place in sorted(places, reverse=True)
            if (file := place / "camera-intrinsics.txt").is_file()
        ),
        None,
    )
    depth_K = camera_matrix(DEPTH_FOCAL, DEPTH_FOCAL, 320, 240, path=path)
    if stated is not None:
        K = read_intrinsics(stated, None)
        if not np.allclose(K, depth_K, rtol=0, atol=0.5):
            return _Sensor(K, None, None)
    if image_size != SIZE:
        what = f"images are {in_words(image_size)}, those of 7-Scenes are 640x480"
        raise UserError(what, path, "write camera-intrinsics.txt with the 3x3 matrix beside them")
    cam_from_depth = np.eye(4)
    cam_from_depth[0, 3] = -ASIDE
    K = camera_matrix(COLOUR_FOCAL, COLOUR_FOCAL, 320, 240, path=path)
    return _Sensor(K, depth_K, cam_from_depth)


def _colour(folder: Path) -> dict[int, Path]:
    return numbered_files(folder, (".color.png", ".color.jpg", ".color.jpeg"), "frame-")


def _sequences(path: Path) -> dict[str, Path]:
    """Folders of frames by the ids' beginning: the folder itself, or those in it."""
    if not path.is_dir():
        return {}
    if _is_sequence(path):
        return {"frame-": path}
    found = {}
    for folder in sorted(path.iterdir()):
        if folder.is_dir() and folder.name.startswith("seq") and _is_sequence(folder):
            found[f"{folder.name}/frame-"] = folder
    return found


def _is_sequence(path: Path) -> bool:
    return any(
        file.name.startswith("frame-") and file.name.endswith(".pose.txt")
        for file in path.iterdir()
    )
