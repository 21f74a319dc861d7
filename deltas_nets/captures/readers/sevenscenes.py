"""7-Scenes and its relatives: frame-000000.color.png, .depth.png and .pose.txt in one folder.

In 7-Scenes, colour and depth are two cameras, the poses are those of the depth camera, and nothing
is registered. 3DMatch, BundleFusion, 3RScan and others took the layout over: they state intrinsics
of their own, in camera-intrinsics.txt, info.txt or _info.txt.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from deltas_nets.captures.capture import Capture, Lost
from deltas_nets.captures.depth_files import MILLIMETRES
from deltas_nets.captures.frame import FloatArray, Frame
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.images import in_words
from deltas_nets.captures.readers.cameras import camera_matrix, fitted
from deltas_nets.captures.readers.image_sizes import doubts_of_sizes, first_size
from deltas_nets.captures.readers.intrinsics import read_intrinsics
from deltas_nets.captures.readers.numbered import numbered_files
from deltas_nets.captures.readers.poses import cam_from_world_of, missing_images
from deltas_nets.captures.readers.sensor_info import SensorInfo, read_sensor_info
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
DEPTHS = (".depth.png", ".depth.pgm")

_REMEDY = "write 4 rows of 4 numbers (camera-to-world), or remove the file and its image"


class _Sensor(NamedTuple):
    """Both cameras.

    Attributes:
        K: ``(3, 3)`` of the colour camera at its images' size.
        depth_K: ``(3, 3)`` of the depth camera; None where they are one.
        depth_size: (height, width) of depth; None where any will do.
        cam_from_depth: where the depth camera stands; None where they stand at one place.
        depth_scale: steps of depth in a metre.
        doubts: what may be a mistake, each for a warning.
    """

    K: FloatArray
    depth_K: FloatArray | None = None
    depth_size: tuple[int, int] | None = None
    cam_from_depth: FloatArray | None = None
    depth_scale: float = MILLIMETRES
    doubts: tuple[str, ...] = ()


def recognises(path: Path) -> bool:
    """Whether the folder is a sequence, or holds sequences."""
    return bool(_sequences(path))


def read(path: Path) -> Capture:
    """Read all sequences; see `deltas_nets.captures.opening.Reader` for the contract."""
    frames: list[Frame] = []
    lost: dict[str, Lost] = {}
    sequences = _sequences(path)
    files = {name: _colour(folder) for name, folder in sequences.items()}
    first = first_size(file for images in files.values() for file in images.values())
    if first is None:
        raise UserError("no image frame-000000.color.png can be decoded", path, "copy them again")
    sensor = _sensor(path, sequences, first)
    for name, folder in sequences.items():
        _read_sequence(name, folder, files[name], first[1], sensor, frames, lost)
    packed = Frames.of(frames, path)
    return Capture(path, packed, lost, sensor.doubts, "7-Scenes", metric=True)


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
    depths = numbered_files(folder, DEPTHS, "frame-")
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
                depth_size=None if depth is None else sensor.depth_size,
                cam_from_depth=None if depth is None else sensor.cam_from_depth,
                depth_scale=sensor.depth_scale,
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


def _sensor(
    path: Path, sequences: Mapping[str, Path], first: tuple[Path, tuple[int, int]]
) -> _Sensor:
    """The cameras as a file beside the images states them, else those of 7-Scenes.

    Args:
        path: the folder that was named.
        sequences: the folders of frames in it.
        first: an image that can be read, and its (height, width).
    """
    places = sorted({path, path.parent, *sequences.values()}, reverse=True)
    files = (place / "camera-intrinsics.txt" for place in places)
    stated = next((file for file in files if file.is_file()), None)
    depth_K = camera_matrix(DEPTH_FOCAL, DEPTH_FOCAL, 320, 240, path=path)
    if stated is not None:
        K = read_intrinsics(stated, None)
        if not np.allclose(K, depth_K, rtol=0, atol=0.5):
            return _Sensor(K)
    else:
        said = [info for place in places if (info := read_sensor_info(place)) is not None]
        if said:
            return _stated_sensor(said[0], sequences.values(), *first)
    if first[1] != SIZE:
        what = f"images are {in_words(first[1])}, those of 7-Scenes are 640x480"
        raise UserError(what, path, "write camera-intrinsics.txt with the 3x3 matrix beside them")
    cam_from_depth = np.eye(4)
    cam_from_depth[0, 3] = -ASIDE
    K = camera_matrix(COLOUR_FOCAL, COLOUR_FOCAL, 320, 240, path=path)
    doubt = (
        "the cameras are taken to be those of 7-Scenes as published (fx 525 of colour, 585 of "
        f"depth, 25 mm aside, not registered), {path}: write camera-intrinsics.txt if they are "
        "others, and register depth before it is compared with anything"
    )
    return _Sensor(K, depth_K, SIZE, cam_from_depth, doubts=(doubt,))


def _stated_sensor(
    info: SensorInfo, sequences: Iterable[Path], image: Path, size: tuple[int, int]
) -> _Sensor:
    """The cameras of a sensor's info, the colour camera's at the size of its images."""
    camera = fitted(info.K, info.size or size, size, image=image)
    depths = (numbered_files(folder, DEPTHS, "frame-").values() for folder in sequences)
    first_depth = first_size(file for files in depths for file in files)
    doubts = doubts_of_sizes([camera])
    if info.moved:
        doubts.append(f"the cameras of colour and depth are taken to be one, {info.path}")
    known = first_depth is not None and info.depth_K is not None
    return _Sensor(
        camera.K,
        info.depth_K if known else None,
        first_depth[1] if first_depth is not None and known else None,
        depth_scale=info.depth_scale or MILLIMETRES,
        doubts=tuple(doubts),
    )


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
