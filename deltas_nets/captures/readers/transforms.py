"""transforms.json of nerfstudio and instant-ngp, and the three files of synthetic NeRF scenes.

Poses are world_from_cam in OpenGL's axes (y up, looking along -z), principal points count from the
image's corner. A world that was scaled (applied_scale) is brought back to its size; one that was
turned (applied_transform) stays so, which changes no depth.
"""

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np

from deltas_nets.captures.capture import Capture, Frame, Lost
from deltas_nets.captures.depth_files import MILLIMETRES
from deltas_nets.captures.file_form import FileForm
from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.points import SparsePoints
from deltas_nets.captures.readers.files import FileFinder
from deltas_nets.captures.readers.image_sizes import (
    SizedCamera,
    at_size,
    doubts_of_sizes,
    first_size,
)
from deltas_nets.captures.readers.json_file import Fields, read_json
from deltas_nets.captures.readers.names import (
    DEPTH_SUFFIXES,
    frame_ids,
    name_parts,
    where_to_put,
    without_common_folder,
)
from deltas_nets.captures.readers.ply import read_points
from deltas_nets.captures.readers.poses import OPENGL, world_from_cam_inverse
from deltas_nets.captures.readers.transforms_cameras import StatedCamera, stated_camera
from deltas_nets.captures.readers.units import is_metric
from deltas_nets.errors import UserError

__all__ = ["read", "recognises"]

NAME = "transforms.json"
PARTS = ("transforms_train.json", "transforms_val.json", "transforms_test.json")
REMEDY = "export it again, or mend it by hand"
DEPTHS = {
    "depth_file_path": "depth_unit_scale_factor",
    "depth_path": "integer_depth_scale",  # instant-ngp's words for the same
}
"""Keys of a frame's depth, and those of the root that say how long its steps are."""


class _Entry(NamedTuple):
    """A frame as the file has it, and what goes for all frames of its file."""

    frame: Fields
    root: Fields
    name: str
    image: Path | None
    camera: StatedCamera


def recognises(path: Path) -> bool:
    """Whether this is such a file, or a folder with one."""
    if path.is_file():
        return path.name.startswith("transforms") and path.suffix == ".json"
    return bool(_files(path))


def read(path: Path) -> Capture:
    """Read the file, or all parts of it; see `deltas_nets.captures.opening.Reader`."""
    folder = path.parent if path.is_file() else path
    files = [path] if path.is_file() else _files(path)
    entries = [entry for file in files for entry in _entries(file)]
    names = [entry.name for entry in entries]
    ids = _ids(names, files[0])
    finder = FileFinder(folder, _image_folders(folder), names=names)
    entries = [entry._replace(image=finder.find(entry.name)) for entry in entries]
    cameras = _sized(entries)
    depths = FileFinder(folder, names=_depth_names(entries), suffixes=DEPTH_SUFFIXES, avoid=(".",))
    clouds = FileFinder(folder, suffixes=(".ply",), avoid=(".",))
    frames: list[Frame] = []
    lost: dict[str, Lost] = {}
    for id, entry in zip(ids, entries, strict=True):
        pose = _pose(entry)
        if isinstance(pose, Lost):
            lost[id] = pose
        elif entry.image is None:
            what = f"the image {entry.name[:80]} is missing"
            error = UserError(what, entry.root.path, where_to_put(entry.name))
            lost[id] = Lost("no image", error)
        else:
            camera = cameras[entry.camera]
            depth_path, step = _depth(entry, depths)
            frames.append(
                Frame(
                    id=id,
                    image_path=entry.image,
                    image_size=camera.image_size,
                    K=camera.K,
                    cam_from_world=pose,
                    depth_path=depth_path,
                    depth_scale=1 / step,
                    depth_unit=step if "depth_file_path" in entry.frame else 1.0,
                    lens=camera.lens,
                )
            )
    root = entries[0].root
    points = _points(root, clouds)
    return Capture(
        path=folder,
        frames=Frames.of(frames, folder),
        lost=lost,
        doubts=(
            *finder.doubts(),
            *doubts_of_sizes(cameras.values()),
            *depths.doubts_of_missing("depth"),
            *clouds.doubts_of_missing("file of points"),
        ),
        layout=files[0].name,
        metric=_metric(root, entries),
        points=points,
        form=FileForm(opengl=True, centre=0.5),
    )


def _files(path: Path) -> list[Path]:
    whole = path / NAME
    parts = [path / name for name in PARTS]
    return [whole] if whole.is_file() else [part for part in parts if part.is_file()]


def _image_folders(folder: Path) -> list[Path]:
    """Besides the folder itself; ScanNet++ has the file in a folder beside the images."""
    of_scannetpp = [folder.parent / "resized_images"] if folder.name == "nerfstudio" else []
    return [folder / "images", *of_scannetpp]


def _entries(file: Path) -> list[_Entry]:
    """All frames of a file, images not looked for; ScanNet++ lists those kept for tests apart."""
    root = Fields(
        read_json(file, name="transforms", remedy=REMEDY), file, where="the file", remedy=REMEDY
    )
    if not root.items("frames"):
        raise root.error("has no frames")
    entries = []
    for index, values in enumerate([*root.items("frames"), *root.items("test_frames")]):
        frame = Fields(values, file, where=f"frame {index}", remedy=REMEDY)
        name = frame.text("file_path")
        if not name_parts(name):
            raise frame.error("has an empty file_path")
        frame.where = f"frame {index} ({name[:80]})"
        entries.append(_Entry(frame, root, name, None, stated_camera(root, frame)))
    return entries


def _ids(names: list[str], file: Path) -> list[str]:
    """Ids from names below images/, or below what all have in common where a name leads out."""
    plain = ["/".join(name_parts(name)) for name in names]
    common = os.path.commonpath([os.path.dirname(name) for name in plain])
    folders = common.split("/")
    images = [place for place, part in enumerate(folders) if part.startswith("images")]
    if images:
        below = len("/".join(folders[: images[-1] + 1])) + 1
        return frame_ids([name[below:] for name in plain], file)
    if any(name.startswith("..") or not _is_relative(name) for name in names):
        return frame_ids(without_common_folder(names), file)
    return frame_ids(plain, file)


def _is_relative(name: str) -> bool:
    return name[:1] not in ("/", "\\") and name[1:2] != ":"


def _sized(entries: list[_Entry]) -> dict[StatedCamera, SizedCamera]:
    """Every camera at the size of its images."""
    files: dict[StatedCamera, list[Path]] = {}
    for entry in entries:
        files.setdefault(entry.camera, []).extend([entry.image] if entry.image else [])
    cameras = {}
    for camera, images in files.items():
        found = first_size(images)
        if found is None:
            found = entries[0].root.path, camera.size or (1, 1)
        image, size = found
        K, stated = camera.K(size), camera.size or size
        cameras[camera] = at_size(K, camera.lens, stated=stated, size=size, image=image)
    return cameras


def _pose(entry: _Entry) -> FloatArray | Lost:
    """``(4, 4)`` cam_from_world, or why there is none."""
    frame = entry.frame
    if "transform_matrix" not in frame:
        return Lost("no pose", frame.error("has no transform_matrix"))
    rows = frame.values.get("transform_matrix")
    num_rows = 3 if isinstance(rows, list) and len(rows) == 3 else 4
    try:
        matrix = frame.numbers("transform_matrix", (num_rows, 4), finite=False)
        scale = entry.root.number("applied_scale", 1.0)
        if scale <= 0:
            raise entry.root.error(f"has an applied_scale of {scale:g}")
    except UserError as error:
        return Lost("malformed", error)
    world_from_cam = np.eye(4)
    world_from_cam[:num_rows] = matrix
    if not np.isfinite(world_from_cam).all():
        return Lost("no pose", frame.error("has a transform_matrix that is not finite"))
    world_from_cam[:3, 3] /= scale
    try:
        return world_from_cam_inverse(world_from_cam * OPENGL, path=frame.path)
    except UserError as error:
        what = f"{frame.where}: {error.what}"
        return Lost("not rigid", UserError(what, frame.path, error.remedy))


def _depth_key(frame: Fields) -> str:
    return next((key for key in reversed(DEPTHS) if key in frame), "depth_file_path")


def _depth_names(entries: list[_Entry]) -> list[str]:
    keyed = ((entry.frame, _depth_key(entry.frame)) for entry in entries)
    return [frame.text(key) for frame, key in keyed if key in frame]


def _depth(entry: _Entry, finder: FileFinder) -> tuple[Path | None, float]:
    """The depth of a frame, and how long one of it is in units of the world.

    nerfstudio multiplies floats by that, too; instant-ngp reads whole numbers alone.
    """
    frame, root = entry.frame, entry.root
    key = _depth_key(frame)
    unit = DEPTHS[key]
    factor = root.number(unit, 1 / MILLIMETRES)
    if factor <= 0:
        raise root.error(f"has a {unit} of {factor:g}")
    if key not in frame:
        return None, factor
    return finder.find(frame.text(key), apart_from=entry.image), factor


def _metric(root: Fields, entries: list[_Entry]) -> bool:
    """What the file says of its unit (our word), else whether a sensor measured depth in it.

    Depth that is missing says as much.
    """
    if "units" in root:
        return is_metric(root)
    return any(key in entry.frame for entry in entries for key in DEPTHS)


def _points(root: Fields, finder: FileFinder) -> SparsePoints | None:
    """The points of a PLY file in the same world."""
    if "ply_file_path" not in root:
        return None
    file = finder.find(root.text("ply_file_path"))
    if file is None:
        return None
    points = read_points(file)
    return points._replace(xyz=points.xyz / root.number("applied_scale", 1.0))
