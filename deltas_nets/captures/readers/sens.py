"""ScanNet's .sens: one file with the cameras, and the images, depth and poses of all frames.

Source: SensorData.h of github.com/ScanNet/ScanNet (the layout, version 4).
"""

import struct
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from deltas_nets.captures.capture import Capture, Lost
from deltas_nets.captures.frame import FloatArray, Frame
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.images import Span
from deltas_nets.captures.readers.cameras import camera_of_matrix
from deltas_nets.captures.readers.listed import listed
from deltas_nets.captures.readers.poses import cam_from_world_of, missing_images
from deltas_nets.errors import UserError

__all__ = ["read", "recognises"]

VERSION = 4
MOST_FRAMES = 200_000
"""Two hours at 30 Hz."""
LONGEST_SIDE = 2**15
_AGAIN = "download the file again"
_PNG, _JPEG = 1, 2
_RAW_DEPTH, _DEFLATED_DEPTH, _OCCI_DEPTH = 0, 1, 2
_FRAME = struct.Struct("<16fQQQQ")


class _Header(NamedTuple):
    """What stands before the frames; sizes are (height, width)."""

    K: FloatArray
    depth_K: FloatArray
    moved: bool
    image_size: tuple[int, int]
    depth_size: tuple[int, int]
    depth_scale: float
    has_depth: bool
    num_frames: int


def recognises(path: Path) -> bool:
    """Whether it is such a file, or a folder with one."""
    return bool(_files(path))


def read(path: Path) -> Capture:
    """Read the cameras and where the frames are; see `deltas_nets.captures.opening.Reader`."""
    files = _files(path)
    if len(files) != 1:
        names = ", ".join(file.name for file in files[:3])
        raise UserError(f"the folder holds {len(files)} scenes ({names})", path, "name one of them")
    (file,) = files
    frames: list[Frame] = []
    lost: dict[str, Lost] = {}
    empty: list[str] = []
    with file.open("rb") as opened:
        size = file.stat().st_size
        header = _header(opened, file)
        for number in range(header.num_frames):
            packed = opened.read(_FRAME.size)
            if len(packed) < _FRAME.size:
                raise _truncated(number, header, file)
            *pose, _, _, colour, depth = _FRAME.unpack(packed)
            start = opened.tell()
            if colour + depth > size - start:
                raise _truncated(number, header, file)
            opened.seek(colour + depth, 1)
            id = str(number)
            placed = cam_from_world_of(np.array(pose).reshape(4, 4), id=id, path=file)
            if not colour:
                empty.append(id)
            elif isinstance(placed, Lost):
                lost[id] = placed
            else:
                frames.append(_frame(id, placed, file, header, Span(start, colour), depth))
    lost |= missing_images(empty, file)
    doubts = []
    if header.moved:
        doubts.append(f"the cameras of colour and depth are taken to be one, {file}")
    if not header.has_depth:
        doubts.append(f"its depth is compressed by OCCI, which is not read, {file}")
    folder = file.parent
    return Capture(folder, Frames.of(frames, folder), lost, tuple(doubts), ".sens", metric=True)


def _frame(
    id: str, pose: FloatArray, file: Path, header: _Header, image: Span, depth: int
) -> Frame:
    has_depth = header.has_depth and depth > 0
    return Frame(
        id=id,
        image_path=file,
        image_size=header.image_size,
        K=header.K,
        cam_from_world=pose,
        depth_path=file if has_depth else None,
        depth_K=header.depth_K if has_depth else None,
        depth_size=header.depth_size if has_depth else None,
        depth_scale=header.depth_scale,
        image_span=image,
        depth_span=Span(image.start + image.length, depth) if has_depth else None,
    )


def _files(path: Path) -> list[Path]:
    if path.is_file():
        return [path] if path.suffix.lower() == ".sens" else []
    return sorted(file for file in listed(path, ".sens") if file.is_file())


def _header(file: BinaryIO, path: Path) -> _Header:
    """Read the header.

    Raises:
        UserError: it is none, is of another version, or claims what cannot be.
    """
    version, length = _read(file, "<IQ", path)
    if version != VERSION:
        raise UserError(f"the file is no .sens of version {VERSION}", path, _AGAIN)
    if length > 4096:
        raise UserError("the file claims a sensor with a name without end", path, _AGAIN)
    file.seek(length, 1)
    matrices = np.array(_read(file, "<64f", path)).reshape(4, 4, 4)
    colour, depth, *sides, scale, count = _read(file, "<iiIIIIfQ", path)
    if colour not in (_PNG, _JPEG):
        raise UserError(f"the images are stored in way {colour}, not as PNG or JPEG", path, _AGAIN)
    if depth not in (_RAW_DEPTH, _DEFLATED_DEPTH, _OCCI_DEPTH) or not all(
        0 < side <= LONGEST_SIDE for side in sides
    ):
        raise UserError("the header is damaged", path, _AGAIN)
    if not 0 < scale < np.inf:
        raise UserError(f"the file claims {scale:g} steps of depth in a metre", path, _AGAIN)
    if count > MOST_FRAMES:
        raise UserError(f"the file claims to hold {count} frames", path, _AGAIN)
    width, height, depth_width, depth_height = sides
    of_colour, colour_place, of_depth, depth_place = matrices
    # Not finite or zero where the writer knew none.
    places = [place for place in (colour_place, depth_place) if 0 < np.abs(place).sum() < np.inf]
    return _Header(
        _intrinsics(of_colour, path),
        _intrinsics(of_depth, path),
        any(np.abs(place - np.eye(4)).max() > 1e-3 for place in places),
        (height, width),
        (depth_height, depth_width),
        scale,
        depth != _OCCI_DEPTH,
        count,
    )


def _intrinsics(matrix: FloatArray, path: Path) -> FloatArray:
    return camera_of_matrix(matrix, path=path)


def _read(file: BinaryIO, form: str, path: Path) -> tuple[Any, ...]:
    packed = file.read(struct.calcsize(form))
    if len(packed) < struct.calcsize(form):
        raise UserError("the header is truncated", path, _AGAIN)
    return struct.unpack(form, packed)


def _truncated(number: int, header: _Header, path: Path) -> UserError:
    what = f"the file is truncated: it holds {number} of {header.num_frames} frames"
    return UserError(what, path, _AGAIN)
