"""ScanNet's export layout: color/N.jpg, depth/N.png, pose/N.txt, intrinsic/*.txt."""

import os
from collections.abc import Mapping, Sequence
from filecmp import cmp
from pathlib import Path
from typing import NamedTuple

import numpy as np

from deltas_nets.captures.camera_words import Intrinsics
from deltas_nets.captures.capture import Capture, FloatArray, Frame, Lost
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.readers.image_sizes import size_of_first
from deltas_nets.captures.readers.intrinsics import doubtful_centre, read_intrinsics
from deltas_nets.captures.readers.poses import world_from_cam_inverse
from deltas_nets.captures.readers.refused import known_layout
from deltas_nets.captures.text_lines import read_numbers
from deltas_nets.errors import UserError

__all__ = ["NESTING", "is_scene", "read", "read_with", "recognises"]

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
NESTING = ("scans_test", "scans")
"""Folders that scenes may lie in, inside of the one that is named."""

_OTHERWISE = "or write frames.json, as docs/captures.md shows"
_NO_POSE = "repair it or take the frame out of the view sets"


class _SceneFiles(NamedTuple):
    """What the folder of one scene holds; poses are not read yet.

    Attributes:
        images: colour images by frame number, in order.
        poses: pose files by frame number.
        depths: depth images by frame number; empty where there is no such folder.
        image_size: (height, width) of the colour images.
        camera: of the colour images.
        depth_K: ``(3, 3)`` of the depth images; None where they see what the images see.
        depth_size: (height, width) of the depth images; None if there are none that decode.
        doubts: what may be a mistake, each for a warning.
    """

    images: Mapping[int, Path]
    poses: Mapping[int, Path]
    depths: Mapping[int, Path]
    image_size: tuple[int, int]
    camera: Intrinsics
    depth_K: FloatArray | None
    depth_size: tuple[int, int] | None
    doubts: tuple[str, ...]


def recognises(path: Path) -> bool:
    """Whether this folder, or a folder of scenes inside it, is laid out this way."""
    if not path.is_dir():
        return False
    nested = any((path / name).is_dir() for name in NESTING)
    return nested or is_scene(path) or any(map(is_scene, path.iterdir()))


def read(path: Path) -> Capture:
    """Read one scene; see `deltas_nets.captures.opening.Reader` for the contract."""
    return read_with(path, None)


def read_with(path: Path, intrinsics: Intrinsics | None) -> Capture:
    """Read one scene; see `deltas_nets.captures.opening.ReaderOfPoses` for the contract."""
    scene = _find_scene(path)
    files = _find_files(scene, intrinsics)
    frames: list[Frame] = []
    lost: dict[str, Lost] = {}
    for number, image_path in files.images.items():
        pose = _read_pose(number, files.poses.get(number), scene)
        if isinstance(pose, Lost):
            lost[str(number)] = pose
            continue
        depth_path = files.depths.get(number)
        frames.append(
            Frame(
                id=str(number),
                image_path=image_path,
                image_size=files.image_size,
                K=files.camera.K,
                lens=files.camera.lens,
                cam_from_world=pose,
                depth_path=depth_path,
                depth_K=None if depth_path is None else files.depth_K,
                depth_size=None if depth_path is None else files.depth_size,
            )
        )
    return Capture(scene, Frames.of(frames, scene), lost, files.doubts)


def _read_pose(number: int, path: Path | None, scene: Path) -> FloatArray | Lost:
    """``(4, 4)`` cam_from_world, or why there is none."""
    if path is None:
        file = scene / "pose" / f"{number}.txt"
        return Lost("no pose", UserError(f"frame {number} has no pose file", file, _NO_POSE))
    remedy = "write 4 rows of 4 numbers (camera-to-world), or remove the file and its image"
    try:
        numbers = read_numbers(path, name="pose", remedy=remedy)
    except UserError as error:
        return Lost("malformed", error)
    if len(numbers) != 16:
        what = f"the pose file has {len(numbers)} numbers, not 16"
        return Lost("malformed", UserError(what, path, remedy))
    world_from_cam = np.array(numbers, dtype=np.float64).reshape(4, 4)
    if not np.isfinite(world_from_cam).all():
        what = f"the pose of frame {number} is not finite"
        return Lost("no pose", UserError(what, path, _NO_POSE))
    try:
        return world_from_cam_inverse(world_from_cam, path=path)
    except UserError as error:
        return Lost("not rigid", error)


def _find_files(scene: Path, stated: Intrinsics | None) -> _SceneFiles:
    """The files of a scene by frame number, and its intrinsics.

    Args:
        scene: the folder that holds color, pose and intrinsic.
        stated: what the user says that the colour images have; the file says it if None.

    Raises:
        UserError: a folder or the images are missing, no pose belongs to an image, or the
            intrinsics are missing or do not fit the images.
    """
    remedies = {
        "color": "put the images there: color/0.jpg, color/1.jpg, ...; " + _OTHERWISE,
        "pose": (
            "put a 4x4 camera-to-world matrix there for each image: pose/0.txt, ...; " + _OTHERWISE
        ),
    }
    for name, remedy in remedies.items():
        if not (scene / name).is_dir():
            # Layouts of radiance fields have a folder pose, too.
            raise known_layout(scene) or UserError(
                f"the capture has no folder {name}", scene, remedy
            )
    images = _files_by_id(scene / "color", IMAGE_SUFFIXES)
    poses = _files_by_id(scene / "pose", (".txt",))
    depths = _files_by_id(scene / "depth", (".png",)) if (scene / "depth").is_dir() else {}
    if not images:
        remedy = "put the images there, named by number: 0.jpg, 1.jpg, ..."
        raise UserError("there are no numbered images", scene / "color", remedy)
    if not images.keys() & poses.keys():
        what = f"no pose belongs to an image ({len(poses)} poses, {len(images)} images)"
        remedy = "name each pose file like its image: pose/7.txt for color/7.jpg"
        raise UserError(what, scene / "pose", remedy)

    image_size = size_of_first(images.values())
    if image_size is None:
        what = f"none of the {len(images)} images can be decoded"
        raise UserError(what, next(iter(images.values())), "copy the files again")
    file = scene / "intrinsic" / "intrinsic_color.txt"
    depth_file = scene / "intrinsic" / "intrinsic_depth.txt"
    depth_size = size_of_first(depths.values())
    doubts = [_misnamed(scene / "color")]
    own_camera = depths and depth_file.exists()
    if stated is None:
        stated = Intrinsics(read_intrinsics(file, image_size), None)
        doubts.append(doubtful_centre(stated.K, image_size, file))
    elif own_camera and depth_size == image_size:
        # A file that is wrong of the images is as wrong of depth registered to them.
        own_camera = not (file.is_file() and cmp(file, depth_file, shallow=False))
    depth_K = None
    # Registered depth often comes without a file of its own: None says "as the colour image".
    if own_camera:
        depth_K = read_intrinsics(depth_file, depth_size)
    elif depth_size is not None:
        doubts.append(_other_shape(depth_size, image_size, depth_file))
    said = tuple(doubt for doubt in doubts if doubt is not None)
    return _SceneFiles(images, poses, depths, image_size, stated, depth_K, depth_size, said)


def is_scene(path: Path) -> bool:
    """Whether the folder itself holds a scene, or the beginning of one."""
    return any(os.path.isdir(path / name) for name in ("color", "pose", "intrinsic"))


def _find_scene(path: Path) -> Path:
    """The folder that holds a scene: this one, or the only one inside."""
    scene = path
    if not is_scene(path):
        nests = [path, *(path / name for name in NESTING if (path / name).is_dir())]
        scenes = sorted(child for nest in nests for child in nest.iterdir() if is_scene(child))
        if not scenes:
            remedy = "put the folders color, pose and intrinsic into a folder of it"
            raise UserError("there is no scene inside", nests[-1], remedy)
        if len(scenes) > 1:
            names = ", ".join(str(scene.relative_to(path)) for scene in scenes[:5])
            more = f" and {len(scenes) - 5} more" if len(scenes) > 5 else ""
            what = f"the folder holds {len(scenes)} scenes ({names}{more})"
            raise UserError(what, path, "name one of them")
        scene = scenes[0]
    return scene


def _files_by_id(folder: Path, suffixes: Sequence[str]) -> dict[int, Path]:
    """Files named by a number, in the order of the numbers; links that lead nowhere are none."""
    found: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in suffixes or not _is_number(path.stem):
            continue
        if path.is_symlink() and not path.exists():
            continue
        id = int(path.stem)
        if id in found:
            what = f"two files stand for frame {id} ({found[id].name} and {path.name})"
            raise UserError(what, folder, "remove one of them")
        found[id] = path
    return dict(sorted(found.items()))


def _is_number(name: str) -> bool:
    return name.isascii() and name.isdigit()


def _misnamed(folder: Path) -> str | None:
    """A warning that names a file with the number or the suffix of an image, but not both."""
    found = sorted(
        path.name
        for path in folder.iterdir()
        if (path.suffix.lower() in IMAGE_SUFFIXES) != _is_number(path.stem)
        and not path.name.startswith(".")
    )
    if not found:
        return None
    more = f" and {len(found) - 1} more" if len(found) > 1 else ""
    return f"left out, {folder / found[0]}{more}: images are N.jpg or N.png, N a number"


def _other_shape(
    depth_size: tuple[int, int], image_size: tuple[int, int], missing: Path
) -> str | None:
    """A warning where depth cannot show what the images show: one of them is turned or cropped."""
    (rows, columns), (height, width) = depth_size, image_size
    if 0.95 < rows * width / (height * columns) < 1.05:
        return None
    return (
        f"depth of {columns}x{rows} is taken to show what images of {width}x{height} show, for "
        f"there is no {missing}"
    )
