"""OpenSfM: reconstruction.json beside the folder images, and tracks.csv if it is there."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from deltas_nets.captures.capture import Capture, Lost
from deltas_nets.captures.frame import FloatArray, Lens
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.points import Observations, SparsePoints
from deltas_nets.captures.readers.cameras import camera_matrix
from deltas_nets.captures.readers.collected import Collected
from deltas_nets.captures.readers.files import FileFinder
from deltas_nets.captures.readers.json_file import Fields, read_json
from deltas_nets.captures.readers.names import frame_ids
from deltas_nets.captures.readers.poses import cam_from_world, rotation_of_vector
from deltas_nets.captures.readers.sparse import observed
from deltas_nets.captures.rigid import rigid
from deltas_nets.captures.text_lines import read_text
from deltas_nets.errors import UserError

__all__ = ["read", "recognises"]

_REMEDY = "run opensfm reconstruct again"
_LENSES = {
    "perspective": ("RADIAL", ("k1", "k2")),
    "simple_radial": ("SIMPLE_RADIAL", ("k1",)),
    "radial": ("RADIAL", ("k1", "k2")),
    "brown": ("FULL_OPENCV", ("k1", "k2", "p1", "p2", "k3", "", "", "")),
    "fisheye": ("OPENCV_FISHEYE", ("k1", "k2", "", "")),
    "fisheye_opencv": ("OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")),
}
"""OpenSfM's projection types as COLMAP's models; an empty name is a coefficient of 0."""


def recognises(path: Path) -> bool:
    """Whether the folder holds a reconstruction, or the file is one."""
    if path.is_file():
        head = _head(path)
        return head.lstrip()[:1] == b"[" and b'"cameras"' in head
    return _file(path) is not None


def read(path: Path) -> Capture:
    """Read the largest reconstruction; see `deltas_nets.captures.opening.Reader`."""
    file = path if path.is_file() else _file(path)
    if file is None:
        raise UserError("there is no reconstruction.json", path, _REMEDY)
    folder = file.parent
    content = read_json(file, name="reconstruction", remedy=_REMEDY)
    each = [
        Fields(item, file, where="a reconstruction", remedy=_REMEDY)
        for item in (content if isinstance(content, list) else [content])
    ]
    if not each:
        raise UserError("the file holds no reconstruction", file, _REMEDY)
    best = max(each, key=lambda fields: len(fields.inner("shots").values))
    shots = best.inner("shots")
    names = sorted(shots.values)
    ids = dict(zip(names, frame_ids(names, file), strict=True))
    finder = FileFinder(folder, (folder / "images", folder.parent / "images"), names=names)
    cameras = _cameras(best)
    found = Collected(file)
    for name, id in ids.items():
        shot = shots.inner(name)
        photo = found.photo(id, finder.find(name))
        if photo is None:
            continue
        called = shot.text("camera")
        if called not in cameras:
            raise shot.error(f"is of the camera {called[:60]!r}, which there is not")
        stated, K, lens = cameras[called]
        found.add(photo, _pose(shot, id), K, stated=stated, lens=lens)
    doubts = finder.doubts()
    if len(each) > 1:
        doubts.append(
            f"the largest of {len(each)} reconstructions is read, with {len(names)} images, {file}"
        )
    capture = found.capture(folder, "OpenSfM", metric=False, doubts=doubts)
    return replace(capture, points=_points(best, folder, capture.frames, ids))


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(4096)


def _file(path: Path) -> Path | None:
    """The reconstruction of a folder; older programs and examples call it a little differently."""
    # OpenDroneMap keeps OpenSfM's folder inside of its own.
    folders = [folder for folder in (path, path / "opensfm") if folder.is_dir()]
    found = (file for folder in folders for file in folder.glob("reconstruction*.json"))
    # The shortest name first: reconstruction.json before reconstruction.meshed.json.
    return min(found, key=lambda file: (len(file.name), file), default=None)


def _cameras(
    reconstruction: Fields,
) -> Mapping[str, tuple[tuple[int, int], FloatArray, Lens | None]]:
    cameras = reconstruction.inner("cameras")
    return {name: _camera(cameras.inner(name)) for name in cameras.values}


def _camera(fields: Fields) -> tuple[tuple[int, int], FloatArray, Lens | None]:
    """(height, width), K, and the lens.

    OpenSfM measures in units of the longer side from the middle of the image, which is at
    (W - 1) / 2 where pixel centres are at integers (its normalized_image_coordinates).
    """
    kind = fields.text("projection_type", "perspective")
    height, width = int(fields.number("height")), int(fields.number("width"))
    longer = max(width, height)
    if min(width, height) < 1:
        raise fields.error(f"is {width}x{height} pixels")
    if kind in ("spherical", "equirectangular"):
        # One turn across the image: what is not used has to be a camera all the same.
        K = camera_matrix(
            width / (2 * np.pi), width / (2 * np.pi), (width - 1) / 2, (height - 1) / 2,
            path=fields.path,
        )  # fmt: skip
        return (height, width), K, Lens("EQUIRECTANGULAR", ())
    if kind not in _LENSES:
        raise fields.error(f"is of the type {kind[:40]!r}, which is not read")
    model, names = _LENSES[kind]
    focal_x = fields.number("focal_x" if "focal_x" in fields else "focal")
    focal_y = fields.number("focal_y", focal_x * fields.number("aspect_ratio", 1.0))
    K = camera_matrix(
        focal_x * longer,
        focal_y * longer,
        fields.number("c_x", 0.0) * longer + (width - 1) / 2,
        fields.number("c_y", 0.0) * longer + (height - 1) / 2,
        path=fields.path,
    )
    coefficients = tuple(fields.number(name, 0.0) if name else 0.0 for name in names)
    straight = not any(coefficients) and "FISHEYE" not in model
    return (height, width), K, None if straight else Lens(model, coefficients)


def _pose(shot: Fields, id: str) -> FloatArray | Lost:
    """World-to-camera, the rotation as an axis times its angle."""
    turn = shot.numbers("rotation", (3,), finite=False)
    shift = shot.numbers("translation", (3,), finite=False)
    return cam_from_world(rigid(rotation_of_vector(turn), shift), id=id, path=shot.path)


def _points(
    reconstruction: Fields, folder: Path, frames: Frames, ids: Mapping[str, str]
) -> SparsePoints | None:
    if "points" not in reconstruction:
        return None
    points = reconstruction.inner("points")
    names = list(points.values)
    if not names:
        return None
    xyz = np.stack([points.inner(name).numbers("coordinates", (3,)) for name in names])
    rgb = np.stack(
        [
            points.inner(name).numbers("color", (3,))
            if "color" in points.inner(name)
            else np.zeros(3)
            for name in names
        ]
    )
    seen = Observations.none()
    tracks = folder / "tracks.csv"
    if not tracks.is_file():
        tracks = next(iter(sorted(folder.glob("tracks*.csv"))), tracks)
    if tracks.is_file():
        seen = _observations(tracks, dict(zip(names, range(len(names)), strict=True)), frames, ids)
    return SparsePoints(xyz, rgb.clip(0, 255).astype(np.uint8), np.full(len(xyz), np.nan), seen)


def _observations(
    path: Path, points: Mapping[str, int], frames: Frames, ids: Mapping[str, str]
) -> Observations:
    """Columns: image, track, feature, x, y, and others that depend on the version."""
    text = read_text(path, name="tracks", remedy="run opensfm create_tracks again")
    place = {id: position for position, id in enumerate(frames)}
    rows = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split("\t")
        if len(words) < 5 or words[1] not in points or ids.get(words[0]) not in place:
            continue
        try:
            x, y = float(words[3]), float(words[4])
        except ValueError as error:
            what = f"line {number} holds {words[3][:20]!r} where a number should be"
            raise UserError(what, path, "run opensfm create_tracks again") from error
        rows.append((points[words[1]], place[ids[words[0]]], x, y))
    seen = observed(rows)
    size = frames.image_sizes[seen.frame][:, ::-1]
    pixels = seen.pixels * size.max(axis=1, keepdims=True) + (size - 1) / 2
    return seen._replace(pixels=pixels)
