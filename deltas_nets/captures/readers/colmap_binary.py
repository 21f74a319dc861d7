"""COLMAP's binary files: cameras.bin, images.bin, points3D.bin. Numbers are little-endian."""

import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deltas_nets.captures.colmap_model import (
    CAMERA_MODELS,
    NO_POINT,
    ColmapCamera,
    ColmapImages,
    ColmapModel,
    ColmapPoints,
    ColmapTracks,
    model_of_id,
)
from deltas_nets.errors import UserError

__all__ = ["CAMERA", "COUNT", "HEAD", "POINT", "TRACKED", "read_binary_model"]

REMEDY = "copy the file again, or export the model from COLMAP again"

HEAD = struct.Struct("<I4d3dI")
"""Of an image: id, quaternion, translation, camera."""
TRACKED = np.dtype([("pixel", "<f8", 2), ("point", "<i8")])
"""A pixel of an image and its point; -1, which COLMAP calls 2^64 - 1, where there is none."""
POINT = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")]
)
"""A point; length times two numbers of 4 bytes follow it."""
_NAME_LIMIT = 4096
_AT_ONCE = 2**16
"""Points that are copied at once: where each byte is takes eight."""


class _Bytes:
    """A file that is read from its start; every count is checked against what is left."""

    def __init__(self, path: Path) -> None:
        try:
            self.data = path.read_bytes()
        except FileNotFoundError as error:
            raise UserError(f"the model has no {path.name}", path, REMEDY) from error
        self.path = path
        self.place = 0

    def take(self, form: struct.Struct) -> tuple[int | float, ...]:
        """The numbers that come next."""
        self.skip(form.size)
        return form.unpack_from(self.data, self.place - form.size)

    def count(self, least: int) -> int:
        """How many things follow, of which each takes some bytes at least."""
        count = int(self.take(COUNT)[0])
        if count * least > len(self.data) - self.place:
            left = len(self.data) - self.place
            what = f"the file is cut short or damaged: {count} entries in {left} bytes"
            raise UserError(what, self.path, REMEDY)
        return count

    def skip(self, length: int) -> int:
        """The place where so many bytes begin; they are read then."""
        start = self.place
        if length > len(self.data) - start:
            raise UserError("the file is cut short", self.path, REMEDY)
        self.place += length
        return start

    def text(self) -> str:
        """Characters up to a 0."""
        end = self.data.find(b"\0", self.place, self.place + _NAME_LIMIT)
        if end < 0:
            raise UserError("the file is damaged: a name has no end", self.path, REMEDY)
        word = self.data[self.place : end]
        self.place = end + 1
        try:
            return word.decode("utf-8")
        except UnicodeDecodeError as error:
            what = f"the file is damaged: a name is no text in UTF-8 ({word[:40]!r})"
            raise UserError(what, self.path, REMEDY) from error


COUNT = struct.Struct("<Q")
CAMERA = struct.Struct("<IiQQ")


def read_binary_model(folder: Path) -> ColmapModel:
    """The model of a folder; points3D.bin may be missing.

    Raises:
        UserError: a file is missing, cut short or damaged.
    """
    cameras = _read_cameras(_Bytes(folder / "cameras.bin"))
    images, tracks = _read_images(_Bytes(folder / "images.bin"))
    points = folder / "points3D.bin"
    return ColmapModel(
        cameras,
        images,
        _read_points(_Bytes(points)) if points.exists() else ColmapPoints.none(),
        tracks,
    )


def _read_cameras(file: _Bytes) -> dict[int, ColmapCamera]:
    cameras: dict[int, ColmapCamera] = {}
    for _ in range(file.count(CAMERA.size)):
        id, model_id, width, height = map(int, file.take(CAMERA))
        name = model_of_id(model_id)
        if name is None:
            raise UserError(f"camera {id} is of an unknown model, {model_id}", file.path, REMEDY)
        if id in cameras:
            raise UserError(f"camera {id} is there twice", file.path, REMEDY)
        params = file.take(struct.Struct(f"<{CAMERA_MODELS[name].num_params}d"))
        cameras[id] = ColmapCamera(name, (height, width), params)
    return cameras


def _read_images(file: _Bytes) -> tuple[ColmapImages, ColmapTracks]:
    heads, names, tracks = [], [], []
    for _ in range(file.count(HEAD.size + 1 + COUNT.size)):
        heads.append(file.take(HEAD))
        names.append(file.text())
        count = file.count(TRACKED.itemsize)
        start = file.skip(count * TRACKED.itemsize)
        pixels = np.frombuffer(file.data, TRACKED, count, start)
        tracks.append(pixels[pixels["point"] != NO_POINT])
    table = np.array(heads, dtype=np.float64).reshape(-1, 9)
    images = ColmapImages(
        table[:, 0].astype(np.int64),
        names,
        table[:, 1:5],
        table[:, 5:8],
        table[:, 8].astype(np.int64),
    )
    seen = np.concatenate([*tracks, np.zeros(0, TRACKED)])
    image = np.repeat(np.arange(len(tracks)), [len(track) for track in tracks])
    return images, ColmapTracks(image, seen["pixel"].copy(), seen["point"].copy())


def _read_points(file: _Bytes) -> ColmapPoints:
    starts = _starts_of_points(file, file.count(POINT.itemsize))
    table = np.empty(len(starts), POINT)
    data, bytes_of_point = np.frombuffer(file.data, np.uint8), np.arange(POINT.itemsize)
    for first in range(0, len(starts), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        raw = np.ascontiguousarray(data[starts[part, None] + bytes_of_point])
        table[part] = raw.view(POINT).reshape(-1)
    ids = table["id"].astype(np.int64)
    return ColmapPoints(ids, table["xyz"].copy(), table["rgb"].copy(), table["error"].copy())


def _starts_of_points(file: _Bytes, count: int) -> NDArray[np.int64]:
    """Where each point begins; tracks are of any length, and the images say the same."""
    starts = np.empty(count, dtype=np.int64)
    data, place, end = file.data, file.place, len(file.data)
    unpack, ahead = COUNT.unpack_from, POINT.itemsize - COUNT.size
    for index in range(count):
        # Before the place is kept: a track's length may be any number of 64 bits.
        if place + POINT.itemsize > end:
            break
        starts[index] = place
        place += POINT.itemsize + 8 * unpack(data, place + ahead)[0]
    else:
        if place <= end:
            return starts
    raise UserError("the file is cut short or damaged", file.path, REMEDY)
