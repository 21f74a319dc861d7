"""COLMAP's text files: cameras.txt, images.txt, points3D.txt."""

import warnings
from collections.abc import Iterator
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
)
from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.text_lines import in_commas
from deltas_nets.errors import UserError

__all__ = ["read_text_model"]

REMEDY = "export the model from COLMAP again (colmap model_converter --output_type TXT)"
LARGEST_ID = 2**53
"""Ids beyond are no numbers of ours: files hold them as text, and we read that as float64."""
_NO_POINT_UNSIGNED = 2.0**63
"""From here on a point's id stands for -1, as an unsigned number of 64 bits."""
_LINE_LIMIT = 2**26
"""Bytes of a line: 2 million pixels with their points."""


def read_text_model(folder: Path) -> ColmapModel:
    """The model of a folder; points3D.txt may be missing.

    Raises:
        UserError: a file is missing, or a line is not what COLMAP writes.
    """
    cameras = _read_cameras(folder / "cameras.txt")
    images, tracks = _read_images(folder / "images.txt")
    points = folder / "points3D.txt"
    return ColmapModel(
        cameras, images, _read_points(points) if points.exists() else ColmapPoints.none(), tracks
    )


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Numbers and texts of all lines, without spaces around them."""
    try:
        with path.open(encoding="utf-8-sig", newline=None) as file:
            number = 0
            while line := file.readline(_LINE_LIMIT):
                number += 1
                if len(line) == _LINE_LIMIT:
                    raise _wrong(path, number, "is too long")
                yield number, line.strip()
    except UnicodeDecodeError as error:
        raise UserError(f"{path.name} is not text in UTF-8", path, REMEDY) from error
    except FileNotFoundError as error:
        raise UserError(f"the model has no {path.name}", path, REMEDY) from error


def _wrong(path: Path, number: int, what: str) -> UserError:
    return UserError(f"line {number} {what}", path, REMEDY)


def _read_cameras(path: Path) -> dict[int, ColmapCamera]:
    cameras: dict[int, ColmapCamera] = {}
    for number, line in _lines(path):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) < 5:
            raise _wrong(path, number, "is no camera: CAMERA_ID MODEL WIDTH HEIGHT PARAMS")
        model = CAMERA_MODELS.get(words[1])
        if model is None:
            raise _wrong(path, number, f"has an unknown camera model, {words[1][:40]}")
        try:
            id, width, height = (int(words[place]) for place in (0, 2, 3))
            params = tuple(map(float, words[4:]))
        except ValueError as error:
            what = f"holds a word where a number should be{in_commas(line)}"
            raise _wrong(path, number, what) from error
        if len(params) != model.num_params:
            what = f"has {len(params)} parameters; {words[1]} has {model.num_params}"
            raise _wrong(path, number, what)
        if id in cameras:
            raise _wrong(path, number, f"is a second camera {id}")
        cameras[id] = ColmapCamera(words[1], (height, width), params)
    return cameras


def _read_images(path: Path) -> tuple[ColmapImages, ColmapTracks]:
    """Images, each on two lines; the second, of its pixels, may be empty."""
    names: list[str] = []
    heads: list[list[float]] = []
    tracks: list[FloatArray] = []
    lines = _lines(path)
    waiting: tuple[int, str] | None = None
    with warnings.catch_warnings():
        # NumPy warns where a word among numbers ends its reading.
        warnings.simplefilter("error", DeprecationWarning)
        while (numbered := waiting or next(lines, None)) is not None:
            waiting = None
            number, line = numbered
            if not line or line.startswith("#"):
                continue
            head = _head(line)
            if head is None:
                what = "is no image: IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
                raise _wrong(path, number, what + in_commas(line))
            heads.append(head[0])
            names.append(head[1])
            number, line = next(lines, (0, ""))
            pixels = _pixels(line)
            if pixels is None and _head(line) is not None:
                waiting = (number, line)  # some programs leave out lines without a pixel
                pixels = np.zeros((0, 3))
            if pixels is None:
                raise _wrong(path, number, "does not list pixels: X Y POINT3D_ID of each")
            tracks.append(pixels[(pixels[:, 2] > NO_POINT) & (pixels[:, 2] < _NO_POINT_UNSIGNED)])
    table = np.array(heads, dtype=np.float64).reshape(-1, 9)
    ids, camera_ids = _whole(table[:, 0], path), _whole(table[:, 8], path)
    images = ColmapImages(ids, names, table[:, 1:5], table[:, 5:8], camera_ids)
    seen = np.concatenate([*tracks, np.zeros((0, 3))])
    image = np.repeat(np.arange(len(tracks)), [len(track) for track in tracks])
    return images, ColmapTracks(image, seen[:, :2], _whole(seen[:, 2], path))


def _head(line: str) -> tuple[list[float], str] | None:
    """The nine numbers and the name of an image, which may hold spaces."""
    words = line.split(maxsplit=9)
    try:
        return ([float(word) for word in words[:9]], words[9]) if len(words) == 10 else None
    except ValueError:
        return None


def _pixels(line: str) -> FloatArray | None:
    try:
        numbers = np.fromstring(line, dtype=np.float64, sep=" ") if line else np.zeros(0)
    except (ValueError, DeprecationWarning):
        return None
    return numbers.reshape(-1, 3) if len(numbers) % 3 == 0 else None


def _read_points(path: Path) -> ColmapPoints:
    """Points; their tracks are not read, for images.txt says the same and where in the image."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # that the file is empty
            table = np.loadtxt(path, usecols=range(8), ndmin=2, comments="#", encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise UserError(f"{path.name} is not text in UTF-8", path, REMEDY) from error
    except (ValueError, IndexError) as error:
        detail = " ".join(str(error).split())[:120]
        what = f"not every line is a point, POINT3D_ID X Y Z R G B ERROR TRACK ({detail})"
        raise UserError(what, path, REMEDY) from error
    table = table.reshape(-1, 8)
    rgb = np.nan_to_num(table[:, 4:7]).clip(0, 255).astype(np.uint8)
    return ColmapPoints(_whole(table[:, 0], path), table[:, 1:4], rgb, table[:, 7])


def _whole(numbers: FloatArray, path: Path) -> NDArray[np.int64]:
    """Ids, as whole numbers."""
    good = (np.abs(numbers) < LARGEST_ID) & (numbers == np.round(numbers))
    if not good.all():
        what = f"an id is no whole number ({numbers[~good][0]:g})"
        raise UserError(what, path, REMEDY)
    return numbers.astype(np.int64)
