"""Our own format: frames.json or frames.csv, and images. docs/captures.md describes it."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from deltas_nets.captures.capture import Capture, Frame, Lost
from deltas_nets.captures.depth_files import MILLIMETRES
from deltas_nets.captures.file_form import FileForm
from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.readers.files import FileFinder
from deltas_nets.captures.readers.image_sizes import SizedCamera, doubts_of_sizes
from deltas_nets.captures.readers.json_file import Fields, read_json
from deltas_nets.captures.readers.names import (
    DEPTH_SUFFIXES,
    check_ids,
    frame_ids,
    name_parts,
    where_to_put,
)
from deltas_nets.captures.readers.own_cameras import (
    OwnCamera,
    depth_camera,
    named_cameras,
    pixel_centre,
    sized,
    stated_camera,
)
from deltas_nets.captures.readers.own_csv import read_csv
from deltas_nets.captures.readers.own_points import read_points
from deltas_nets.captures.readers.own_poses import pose_of
from deltas_nets.captures.readers.own_table import (
    FRAME,
    REMEDY,
    ROOT,
    VERSION,
    check_keys,
)
from deltas_nets.captures.readers.units import is_metric
from deltas_nets.errors import UserError

__all__ = ["NAMES", "read", "recognises"]

NAMES = ("frames.json", "frames.csv")


class _Entry(NamedTuple):
    """A frame as the file has it."""

    id: str
    fields: Fields
    image: Path | None
    camera: OwnCamera


def recognises(path: Path) -> bool:
    """Whether this is such a file, or a folder with one."""
    return path.name in NAMES if path.is_file() else any((path / name).is_file() for name in NAMES)


def read(path: Path) -> Capture:
    """Read the file; see `deltas_nets.captures.opening.Reader` for the contract."""
    files = [path] if path.is_file() else [path / name for name in NAMES]
    file = next(file for file in files if file.is_file())
    root = _root(file)
    entries, finder = _entries(root, file)
    images: dict[OwnCamera, list[Path]] = {}
    for entry in entries:
        images.setdefault(entry.camera, []).extend([entry.image] if entry.image else [])
    cameras = sized(images, file)
    names = [entry.fields.text("depth") for entry in entries if "depth" in entry.fields]
    depths = FileFinder(file.parent, names=names, suffixes=DEPTH_SUFFIXES, avoid=(".",))
    frames: list[Frame] = []
    lost: dict[str, Lost] = {}
    for entry in entries:
        frame = _frame(entry, cameras[entry.camera], root, depths)
        if isinstance(frame, Lost):
            lost[entry.id] = frame
        else:
            frames.append(frame)
    packed = Frames.of(frames, file.parent)
    ignored = [
        f"{other.name} is not read, as {file.name} is there"
        for other in files[1:]
        if other.is_file() and other != file
    ]
    ids = [entry.id for entry in entries]
    fields = dict(zip(ids, (entry.fields for entry in entries), strict=True))
    used = [fields[id] for id in packed]
    scales = np.array([cameras[entry.camera].scale for entry in entries])
    return Capture(
        path=file.parent,
        frames=packed,
        lost=lost,
        doubts=(
            *ignored,
            *finder.doubts(),
            *doubts_of_sizes(cameras.values()),
            *depths.doubts_of_missing("depth"),
        ),
        layout=file.name,
        metric=is_metric(root),
        points=read_points(root, file.parent, ids, packed, scales),
        sources=_sources(used, list(packed), ids),
        depth_ranges=_depth_ranges(root, used),
        form=FileForm(centre=pixel_centre(root)),
    )


def _entries(root: Fields, file: Path) -> tuple[list[_Entry], FileFinder]:
    fields = [
        Fields(values, file, where=f"frame {index}", remedy=REMEDY)
        for index, values in enumerate(root.items("frames"))
    ]
    for frame in fields:
        check_keys(frame, FRAME)
    cameras = named_cameras(root)
    ids, names = _ids(fields, file), [frame.text("image") for frame in fields]
    finder = FileFinder(file.parent, [file.parent / "images"], names=names)
    entries = []
    for id, frame, image in zip(ids, fields, names, strict=True):
        frame.where = f"{frame.where} ({image[:80]})"
        camera = stated_camera(root, frame, cameras)
        entries.append(_Entry(id, frame, finder.find(image), camera))
    return entries, finder


def _frame(entry: _Entry, camera: SizedCamera, root: Fields, depths: FileFinder) -> Frame | Lost:
    """A frame, or why it cannot be used."""
    fields = entry.fields
    pose = pose_of(fields)
    if isinstance(pose, Lost):
        return pose
    if entry.image is None:
        name = fields.text("image")
        what = f"the image {name[:80]} is missing"
        return Lost("no image", UserError(what, fields.path, where_to_put(name)))
    frame = Frame(
        id=entry.id,
        image_path=entry.image,
        image_size=camera.image_size,
        K=camera.K,
        cam_from_world=pose,
        lens=camera.lens,
    )
    if "depth" not in fields:
        return frame
    depth = depths.find(fields.text("depth"), apart_from=entry.image)
    if depth is None:
        return frame
    scale = (fields if "depth_scale" in fields else root).number("depth_scale", MILLIMETRES)
    if scale <= 0:
        raise fields.error(f"has a depth_scale of {scale:g}")
    K, size, cam_from_depth = depth_camera(root, fields) or (None, None, None)
    return replace(
        frame,
        depth_path=depth,
        depth_scale=scale,
        depth_K=K,
        depth_size=size,
        cam_from_depth=cam_from_depth,
    )


def _root(file: Path) -> Fields:
    """What the file says, with a version that is read and no unknown key."""
    values = (
        read_csv(file) if file.suffix == ".csv" else read_json(file, name="frames", remedy=REMEDY)
    )
    root = Fields(values, file, where="the file", remedy=REMEDY)
    version = root.number("version", VERSION)
    if version != VERSION:
        what = f"the file is of version {version:g}, this program reads {VERSION}"
        raise UserError(what, file, "install a newer deltas-depth" if version > VERSION else REMEDY)
    check_keys(root, ROOT)
    is_metric(root)
    if not root.items("frames"):
        raise root.error("has no frames")
    return root


def _ids(frames: Sequence[Fields], file: Path) -> list[str]:
    """Ids as stated, or from the images below the folder images."""
    names = ["/".join(name_parts(frame.text("image"))) for frame in frames]
    if not all(names):
        raise frames[names.index("")].error("has an empty image")
    stated = [_id(frame) if "id" in frame else None for frame in frames]
    if None in stated:
        below = [name.removeprefix("images/") for name in names]
        from_names = frame_ids(below, file)
        stated = [id or name for id, name in zip(stated, from_names, strict=True)]
    ids = [id for id in stated if id is not None]
    check_ids(ids, file)
    return ids


def _id(frame: Fields) -> str:
    value = frame.values["id"]
    whole = isinstance(value, int) and not isinstance(value, bool)
    return str(value) if whole else frame.text("id")


def _depth_ranges(root: Fields, frames: Sequence[Fields]) -> FloatArray | None:
    """``(F, 2)`` of the frames, or what the root says of all."""
    stated = [frame if "depth_range" in frame else root for frame in frames]
    without = [
        frame for frame, said in zip(frames, stated, strict=True) if "depth_range" not in said
    ]
    if len(without) == len(frames):
        return None
    if without:
        raise without[0].error("has no depth_range, while others have")
    ranges = np.array([said.numbers("depth_range", (2,)) for said in stated])
    wrong = ~((ranges[:, 0] > 0) & (ranges[:, 0] < ranges[:, 1]))
    if wrong.any():
        raise stated[int(wrong.argmax())].error("has a depth_range that is not 0 < near < far")
    return ranges


def _sources(
    frames: Sequence[Fields], ids: Sequence[str], known: Sequence[str]
) -> dict[str, tuple[str, ...]] | None:
    """The views that go with each frame, those that are lost left out.

    A frame that states none is not among them, nor is one of whose views all are lost.
    """
    usable, all_ids = set(ids), set(known)
    sources = {}
    for id, frame in zip(ids, frames, strict=True):
        names = [str(name) for name in frame.items("sources")]
        unknown = next((name for name in names if name not in all_ids), None)
        if unknown is not None:
            raise frame.error(f"has a source {unknown[:40]!r}, which is no frame")
        found = tuple(name for name in names if name in usable and name != id)
        if found or ("sources" in frame and not names):
            sources[id] = found
    return sources or None
