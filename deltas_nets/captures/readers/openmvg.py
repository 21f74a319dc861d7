"""OpenMVG: sfm_data.json, wherever it lies, and the images that it names."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from deltas_nets.captures.capture import Capture, Lost
from deltas_nets.captures.frame import FloatArray, Lens
from deltas_nets.captures.points import SparsePoints
from deltas_nets.captures.readers.cameras import camera_matrix
from deltas_nets.captures.readers.collected import Collected
from deltas_nets.captures.readers.files import FileFinder
from deltas_nets.captures.readers.json_file import Fields, read_json
from deltas_nets.captures.readers.names import frame_ids, name_parts
from deltas_nets.captures.readers.poses import cam_from_world
from deltas_nets.captures.readers.sparse import observed
from deltas_nets.captures.rigid import rigid
from deltas_nets.errors import UserError

__all__ = ["read", "recognises"]

_REMEDY = "export it again: openMVG_main_ConvertSfM_DataFormat -i sfm_data.bin -o sfm_data.json"
_LENSES: Mapping[str, tuple[str, str, tuple[int, ...]]] = {
    "pinhole": ("", "", ()),
    "pinhole_radial_k1": ("SIMPLE_RADIAL", "disto_k1", (0,)),
    "pinhole_radial_k3": ("FULL_OPENCV", "disto_k3", (0, 1, -1, -1, 2, -1, -1, -1)),
    "pinhole_brown_t2": ("FULL_OPENCV", "disto_t2", (0, 1, 3, 4, 2, -1, -1, -1)),
    "fisheye": ("OPENCV_FISHEYE", "fisheye", (0, 1, 2, 3)),
}
"""OpenMVG's models as COLMAP's: the name, the field of coefficients, and which is where in COLMAP's
order; -1 is a coefficient of 0."""
_NESTING = ("", "reconstruction*/", "*/", "*/reconstruction*/", "*/*/")


class _View(NamedTuple):
    key: int
    name: str
    size: tuple[int, int]
    intrinsic: int
    pose: int


def recognises(path: Path) -> bool:
    """Whether the folder holds sfm_data.json at most two folders down, or the file is one."""
    if path.is_file():
        return b'"sfm_data_version"' in _head(path)
    return _file(path) is not None


def read(path: Path) -> Capture:
    """Read a scene; see `deltas_nets.captures.opening.Reader` for the contract."""
    file = path if path.is_file() else _file(path)
    if file is None:
        raise UserError("there is no sfm_data.json", path, _REMEDY)
    scene = Fields(
        read_json(file, name="scene", remedy=_REMEDY), file, where="the scene", remedy=_REMEDY
    )
    folder = file.parent if path.is_file() else path
    views = list(_views(scene))
    names = [view.name for view in views]
    ids = frame_ids(names, file)
    finder = FileFinder(folder, _image_folders(scene, folder, file), names=names)
    cameras = _cameras(scene)
    poses = dict(_items(scene, "extrinsics"))
    found = Collected(file)
    for view, id in zip(views, ids, strict=True):
        if view.pose not in poses or view.intrinsic not in cameras:
            what = f"frame {id} has no pose: OpenMVG could not place it"
            found.without_pose(id, UserError(what, file, "take it out of the view sets"))
            continue
        photo = found.photo(id, finder.find(view.name))
        if photo is not None:
            K, lens = cameras[view.intrinsic]
            found.add(photo, _pose(poses[view.pose], id), K, stated=view.size, lens=lens)
    capture = found.capture(folder, "OpenMVG", metric=False, doubts=finder.doubts())
    place = {id: position for position, id in enumerate(capture.frames)}
    position = {view.key: place[id] for view, id in zip(views, ids, strict=True) if id in place}
    return replace(capture, points=_points(scene, position))


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(4096)


def _file(path: Path) -> Path | None:
    if not path.is_dir():
        return None
    for nest in _NESTING:
        found = sorted(path.glob(f"{nest}sfm_data.json"))
        # Of several, those of a reconstruction have poses; the list of images alone has none.
        posed = [file for file in found if "reconstruction" in file.parent.name]
        if found:
            return (posed or found)[0]
    return None


def _image_folders(scene: Fields, folder: Path, file: Path) -> list[Path]:
    stated = name_parts(scene.text("root_path", ""))[-1:]
    places = (folder, file.parent, file.parent.parent, file.parent.parent.parent)
    return [place / name for place in places for name in ("images", *stated)]


def _items(scene: Fields, key: str) -> Iterator[tuple[int, Fields]]:
    """OpenMVG writes a map as a list of keys and values."""
    for item in scene.items(key):
        entry = Fields(item, scene.path, where=f"an entry of {key}", remedy=scene.remedy)
        yield int(entry.number("key")), entry.inner("value")


def _data(value: Fields) -> Fields:
    return value.inner("ptr_wrapper").inner("data")


def _views(scene: Fields) -> Iterator[_View]:
    for key, value in _items(scene, "views"):
        data = _data(value)
        # Priors on the pose nest what all views have.
        data = data.inner("value0") if "filename" not in data and "value0" in data else data
        folder, name = data.text("local_path", ""), data.text("filename")
        yield _View(
            key,
            "/".join((*name_parts(folder), *name_parts(name))),
            (int(data.number("height")), int(data.number("width"))),
            int(data.number("id_intrinsic")),
            int(data.number("id_pose")),
        )


def _cameras(scene: Fields) -> dict[int, tuple[FloatArray, Lens | None]]:
    """By id.

    A type is named where it comes first, later only its number is repeated. Pixel centres are at
    integers: OpenMVG samples images and undistorts them at whole (x, y), and its features' are so.
    """
    cameras: dict[int, tuple[FloatArray, Lens | None]] = {}
    names: dict[int, str] = {}
    first_of_type = 2**31
    for key, value in _items(scene, "intrinsics"):
        number = int(value.number("polymorphic_id")) % first_of_type
        if "polymorphic_name" in value:
            names[number] = value.text("polymorphic_name")
        kind = names.get(number, "")
        data = _data(value)
        pinhole = data.inner("value0") if "focal_length" not in data and "value0" in data else data
        if kind == "spherical":
            width, height = pinhole.number("width"), pinhole.number("height")
            turn = width / (2 * np.pi)
            K = camera_matrix(turn, turn, (width - 1) / 2, (height - 1) / 2, path=scene.path)
            cameras[key] = K, Lens("EQUIRECTANGULAR", ())
            continue
        if kind not in _LENSES:
            raise data.error(f"is of a camera {kind[:40]!r}, which is not read")
        model, field, order = _LENSES[kind]
        focal = pinhole.number("focal_length")
        cx, cy = pinhole.numbers("principal_point", (2,))
        K = camera_matrix(focal, focal, float(cx), float(cy), path=scene.path)
        lens = None
        if model:
            stated = data.numbers(field, (1 + max(order),))
            coefficients = tuple(float(stated[at]) if at >= 0 else 0.0 for at in order)
            if any(coefficients) or kind == "fisheye":
                lens = Lens(model, coefficients)
        cameras[key] = K, lens
    return cameras


def _pose(value: Fields, id: str) -> FloatArray | Lost:
    """x = R (X - center)."""
    rotation = value.numbers("rotation", (3, 3), finite=False)
    centre = value.numbers("center", (3,), finite=False)
    with np.errstate(invalid="ignore", over="ignore"):
        return cam_from_world(rigid(rotation, -rotation @ centre), id=id, path=value.path)


def _points(scene: Fields, position: Mapping[int, int]) -> SparsePoints | None:
    points: list[FloatArray] = []
    rows: list[tuple[int, int, float, float]] = []
    for _, value in _items(scene, "structure"):
        for view, seen in _items(value, "observations"):
            if view in position:
                x, y = seen.numbers("x", (2,))
                rows.append((len(points), position[view], float(x), float(y)))
        points.append(value.numbers("X", (3,)))
    if not points:
        return None
    xyz = np.stack(points)
    return SparsePoints(
        xyz, np.zeros((len(xyz), 3), np.uint8), np.full(len(xyz), np.nan), observed(rows)
    )
