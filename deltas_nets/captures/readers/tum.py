"""TUM RGB-D: rgb.txt, depth.txt and groundtruth.txt, each line with a time stamp of its own."""

import os
import warnings
from collections.abc import Iterator, Sequence
from io import StringIO
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from deltas_nets.captures.camera_words import Intrinsics, named_camera
from deltas_nets.captures.capture import Capture, Lost
from deltas_nets.captures.frame import FloatArray, Frame
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.images import in_words
from deltas_nets.captures.readers.image_sizes import size_of_first
from deltas_nets.captures.readers.names import frame_ids, without_common_folder
from deltas_nets.captures.readers.poses import cam_from_world_of
from deltas_nets.captures.readers.trajectory import GAP, Trajectory, nearest_stamps
from deltas_nets.captures.text_lines import in_commas, read_text
from deltas_nets.errors import UserError

__all__ = ["read", "read_with", "recognises"]

STEPS = 5000.0
"""Steps of depth in a metre."""
APART = 0.02
"""Seconds between an image and its depth at most, as in the data set's own associate.py."""
KNOWN_SIZE = 480, 640

_LIST_REMEDY = "write a time stamp and a file's name on each line"
_POSE_REMEDY = "write timestamp tx ty tz qx qy qz qw (camera-to-world) on each line"


class _Listed(NamedTuple):
    """Files in the order of their stamps.

    Attributes:
        stamps: ``(F,)`` seconds.
        names: of files that are there, from the capture's folder.
        missing: how many are listed but not there.
    """

    stamps: FloatArray
    names: Sequence[str]
    missing: int


def recognises(path: Path) -> bool:
    """Whether the folder has the list of images."""
    return (path / "rgb.txt").is_file()


def read(path: Path) -> Capture:
    """Read a folder whose name, lists or intrinsics.txt say which camera it is."""
    return read_with(path, None)


def read_with(path: Path, intrinsics: Intrinsics | None) -> Capture:
    """Read a folder; see `deltas_nets.captures.opening.Reader` for the contract."""
    images = _read_list(path / "rgb.txt")
    depths = _Listed(np.zeros(0), (), 0)
    if (path / "depth.txt").is_file():
        depths = _read_list(path / "depth.txt")
    if not images.names:
        what = f"none of the {images.missing} images of the list is there"
        raise UserError(what, path / "rgb.txt", "put them into the folder rgb")
    image_size = size_of_first(path / name for name in images.names)
    if image_size is None:
        raise UserError("no image can be decoded", path / images.names[0], "copy the files again")
    camera, said = _camera(path, image_size) if intrinsics is None else (intrinsics, "")
    trajectory = _read_trajectory(path / "groundtruth.txt")
    _check_clocks(trajectory.stamps, images.stamps, path / "groundtruth.txt")
    poses = trajectory.poses_at(images.stamps)
    nearest = nearest_stamps(images.stamps, depths.stamps, apart=APART)
    frames, lost, late = [], {}, 0
    ids = frame_ids(without_common_folder(images.names), path / "rgb.txt")
    for place, (id, name) in enumerate(zip(ids, images.names, strict=True)):
        pose = _pose(poses[place], id, images.stamps[place], path / "groundtruth.txt")
        if isinstance(pose, Lost):
            lost[id] = pose
            continue
        depth = None if nearest[place] < 0 else path / depths.names[nearest[place]]
        late += depth is None
        frames.append(
            Frame(
                id=id,
                image_path=path / name,
                image_size=image_size,
                K=camera.K,
                lens=camera.lens,
                cam_from_world=pose,
                depth_path=depth,
                depth_scale=STEPS,
            )
        )
    doubts = []
    if images.missing:
        what = f"{images.missing} of {images.missing + len(images.names)} images listed"
        doubts.append(f"{what} are not there and are left out, {path / 'rgb.txt'}")
    if late and depths.names:
        what = f"{late} images have no depth within {APART} s of their time stamp"
        doubts.append(f"{what}, {path / 'depth.txt'}")
    return Capture(
        path, Frames.of(frames, path), lost, tuple(doubts), f"TUM RGB-D{said}", metric=True
    )


def _camera(path: Path, image_size: tuple[int, int]) -> tuple[Intrinsics, str]:
    """The camera of a folder that states it, and a word on where from."""
    for name in ("intrinsics.txt", "camera.txt", "calibration.txt"):
        if (path / name).is_file():
            remedy = "write fx fy cx cy, and k1 k2 p1 p2 k3 of a lens, or pass --intrinsics"
            text = read_text(path / name, name="intrinsics", remedy=remedy)
            lines = (line.partition("#")[0] for line in text.splitlines())
            return Intrinsics.parse(" ".join(lines), path / name), f", {name}"
    lists = (path / name for name in ("rgb.txt", "groundtruth.txt"))
    for words in (path.resolve().name, *(_head(file) for file in lists if file.is_file())):
        camera = named_camera(words)
        if camera is None:
            continue
        if image_size != KNOWN_SIZE:
            what = f"images are {in_words(image_size)}, those of TUM's cameras 640x480"
            raise UserError(what, path, "pass --intrinsics 'fx fy cx cy' for this size")
        return camera, ", a known camera"
    what = "nothing says which camera this is: TUM RGB-D has no intrinsics"
    remedy = "pass --intrinsics freiburg1 (or 2, 3) or --intrinsics 'fx fy cx cy k1 k2 p1 p2 k3'"
    raise UserError(what, path, remedy)


def _head(path: Path) -> str:
    """The comments above a list, which name the recording."""
    with path.open(encoding="utf-8", errors="replace") as file:
        return " ".join(line[:200] for line in islice(file, 3) if line.startswith("#"))


def _read_list(path: Path) -> _Listed:
    stamps, names, missing = [], [], 0
    known: dict[str, frozenset[str]] = {}
    text = read_text(path, name="list of images", remedy=_LIST_REMEDY)
    for number, words in _lines(text):
        if len(words) < 2:
            raise UserError(f"line {number} has no name of a file", path, _LIST_REMEDY)
        stamp = _number(words[0], number, path)
        # A name may hold spaces; four words are two lists joined by associate.py.
        name = words[1] if len(words) == 4 else " ".join(words[1:])
        if _is_there(path.parent, name, known):
            stamps.append(stamp)
            names.append(name)
        else:
            missing += 1
    order = np.argsort(stamps, kind="stable")
    return _Listed(np.array(stamps)[order], [names[place] for place in order], missing)


def _is_there(folder: Path, name: str, known: dict[str, frozenset[str]]) -> bool:
    """Whether a folder below holds a file; each folder is listed once."""
    above, _, file = name.rpartition("/")
    if above not in known:
        parts = above.split("/")
        inside = ".." not in parts and not name.startswith("/") and "\0" not in name
        try:
            known[above] = frozenset(os.listdir(folder / above) if inside else ())
        except OSError:
            known[above] = frozenset()
    return file in known[above] and (folder / name).is_file()


def _read_trajectory(path: Path) -> Trajectory:
    text = read_text(path, name="list of poses", remedy=_POSE_REMEDY)
    try:
        with warnings.catch_warnings(action="ignore"):
            table = np.loadtxt(StringIO(text.replace(",", " ")), comments="#", ndmin=2)
    except ValueError:
        table = np.zeros((1, 0))
    if not table.size and table.shape[0] != 1:
        raise UserError("the list of poses is empty", path, _POSE_REMEDY)
    if table.shape[1] != 8 or not np.isfinite(table[:, 0]).all():
        raise _wrong_line(text, path)
    table = table[np.argsort(table[:, 0], kind="stable")]
    return Trajectory(table[:, 0], table[:, 1:4], table[:, [7, 4, 5, 6]])


def _check_clocks(poses: FloatArray, images: FloatArray, path: Path) -> None:
    """Refuse poses of another time than all images, as in nanoseconds or of another clock."""
    if poses[-1] < images[0] - GAP or images[-1] + GAP < poses[0]:
        what = (
            f"poses are of the times {poses[0]:.15g} to {poses[-1]:.15g}, "
            f"images of {images[0]:.15g} to {images[-1]:.15g}"
        )
        raise UserError(what, path, "write stamps of both in seconds of one clock")


def _wrong_line(text: str, path: Path) -> UserError:
    """The first line that is no pose."""
    lines = text.splitlines()
    for number, words in _lines(text):
        if len(words) != 8:
            what = f"line {number} has {len(words)} numbers, not 8{in_commas(lines[number - 1])}"
            return UserError(what, path, _POSE_REMEDY)
        try:
            numbers = [float(word) for word in words]
            finite = np.isfinite(numbers[0])
        except ValueError:
            finite = False
        if not finite:
            what = f"line {number} holds {' '.join(words)[:40]!r} where numbers should be"
            return UserError(what, path, _POSE_REMEDY)
    return UserError("the list of poses is malformed", path, _POSE_REMEDY)


def _lines(text: str) -> Iterator[tuple[int, list[str]]]:
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.partition("#")[0].replace(",", " ").split()
        if words:
            yield number, words


def _number(word: str, line: int, path: Path) -> float:
    try:
        value = float(word)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise UserError(f"line {line} begins with {word[:20]!r}, no time stamp", path, _LIST_REMEDY)
    return value


def _pose(world_from_cam: FloatArray, id: str, stamp: float, path: Path) -> FloatArray | Lost:
    if not np.isfinite(world_from_cam).all():
        what = f"there is no pose at the time {stamp:.6f} of frame {id}"
        remedy = f"add poses no more than {GAP} s apart, or take the frame out of the view sets"
        return Lost("no pose", UserError(what, path, remedy))
    return cam_from_world_of(world_from_cam, id=id, path=path)
