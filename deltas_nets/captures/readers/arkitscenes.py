"""ARKitScenes: lowres_wide.traj beside folders of images, intrinsics of each, and depth.

Source: threedod/benchmark_scripts/utils/tenFpsDataLoader.py of github.com/apple/ARKitScenes, which
inverts the poses of the .traj file before it takes points of a camera to the world.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from deltas_nets.captures.capture import Capture, Lost
from deltas_nets.captures.file_form import FileForm
from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.readers.cameras import CORNER, camera_matrix
from deltas_nets.captures.readers.collected import Collected
from deltas_nets.captures.readers.listed import listed
from deltas_nets.captures.readers.poses import cam_from_world_of
from deltas_nets.captures.readers.trajectory import Trajectory, nearest_stamps
from deltas_nets.captures.rotations import rotations_of
from deltas_nets.captures.text_lines import read_lines, read_numbers
from deltas_nets.errors import UserError

__all__ = ["read", "recognises"]

_TRAJECTORY = "lowres_wide.traj"
_IMAGES = ("vga_wide", "lowres_wide")
"""Folders of the camera that was tracked, the larger images first."""
_DEPTH = "lowres_depth"
GAP = 0.15
"""Seconds between two poses over which to interpolate: they come ten times a second, unevenly."""
APART = 0.005
"""Seconds between an image and its depth at most: times in names are rounded."""
_REMEDY = "download the scan again, with lowres_wide, its intrinsics and lowres_wide.traj"


def recognises(path: Path) -> bool:
    """Whether the folder is a scan, raw or of the 3D detection part."""
    return _folder(path) is not None


def read(path: Path) -> Capture:
    """Read a scan; see `deltas_nets.captures.opening.Reader` for the contract."""
    folder = _folder(path) or path
    name = next((name for name in _IMAGES if _stamped(folder / name, (".png", ".jpg"))), _IMAGES[1])
    images = _stamped(folder / name, (".png", ".jpg"))
    cameras = _stamped(folder / f"{name}_intrinsics", (".pincam",))
    depths = _stamped(folder / _DEPTH, (".png",))
    if not images or not cameras:
        missing = name if cameras else f"{name}_intrinsics"
        raise UserError(f"the scan has no {missing}", folder, _REMEDY)
    found = Collected(folder / name)
    stamps = np.array(list(images))
    poses = _trajectory(folder / _TRAJECTORY).poses_at(stamps, gap=GAP)
    cameras_at = list(cameras.values())
    camera_of = nearest_stamps(stamps, np.array(list(cameras)), apart=np.inf)
    depths_at = list(depths.values())
    depth_of = nearest_stamps(stamps, np.array(list(depths)), apart=APART)
    for place, (file, pose) in enumerate(zip(images.values(), poses, strict=True)):
        id = file.stem.rpartition("_")[2]
        photo = found.photo(id, file)
        if photo is None:
            continue
        K, size = _camera(cameras_at[camera_of[place]])
        found.add(
            photo,
            _pose(pose, id, folder / _TRAJECTORY),
            K,
            stated=size,
            depth=depths_at[depth_of[place]] if depth_of[place] >= 0 else None,
        )
    return found.capture(folder, "ARKitScenes", metric=True, form=FileForm(centre=CORNER))


def _folder(path: Path) -> Path | None:
    """The folder with the trajectory: this one, or NAME_frames in it."""
    for folder in (path, path / f"{path.name}_frames"):
        if (folder / _TRAJECTORY).is_file():
            return folder
    return None


def _stamped(folder: Path, suffixes: Sequence[str]) -> dict[float, Path]:
    """Files by the time in their name, NAME_SECONDS, in order."""
    found = {}
    for file in listed(folder, *suffixes) if folder.is_dir() else ():
        seconds = file.stem.rpartition("_")[2]
        if seconds.replace(".", "", 1).isdecimal():
            found[float(seconds)] = file
    return dict(sorted(found.items()))


def _camera(path: Path) -> tuple[FloatArray, tuple[int, int]]:
    """K and (height, width); ARKit measures the principal point from the corner of the image."""
    remedy = "write width height fx fy cx cy"
    numbers = read_numbers(path, name="intrinsics", remedy=remedy)
    if len(numbers) != 6 or not all(1 <= side < 2**20 for side in numbers[:2]):
        raise UserError("the intrinsics are no camera", path, remedy)
    width, height, fx, fy, cx, cy = numbers
    return camera_matrix(fx, fy, cx - CORNER, cy - CORNER, path=path), (int(height), int(width))


def _pose(world_from_cam: FloatArray, id: str, path: Path) -> FloatArray | Lost:
    if np.isfinite(world_from_cam).all():
        return cam_from_world_of(world_from_cam, id=id, path=path)
    what = f"there is no pose near the time of frame {id}"
    return Lost("no pose", UserError(what, path, "take the frame out of the view sets"))


def _trajectory(path: Path) -> Trajectory:
    """Lines of seconds, a rotation as its axis times its angle, a translation: world-to-camera."""
    remedy = "write seconds, three numbers of rotation and three of translation on each line"
    rows = []
    for number, words in read_lines(path, name="list of poses", remedy=remedy):
        try:
            rows.append([float(word) for word in words])
        except ValueError:
            rows.append([])
        if len(rows[-1]) != 7 or not np.isfinite(rows[-1][0]):
            raise UserError(f"line {number} is no pose", path, remedy)
    if not rows:
        raise UserError("the list of poses is empty", path, remedy)
    table = np.array(rows)
    table = table[np.argsort(table[:, 0], kind="stable")]
    turn, shift = table[:, 1:4], table[:, 4:]
    with np.errstate(all="ignore"):
        angle = np.linalg.norm(turn, axis=1, keepdims=True)
        part = 0.5 * np.sinc(angle / (2 * np.pi))
        quaternions = np.concatenate([np.cos(angle / 2), -part * turn], axis=1)
        centres = -np.einsum("pij,pj->pi", rotations_of(quaternions), shift)
    return Trajectory(table[:, 0], centres, quaternions)
