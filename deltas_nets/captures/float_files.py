"""PFM, NPY and NPZ files, read within the bounds of the file's own length, without pickle."""

import re
import zlib
from io import BytesIO
from pathlib import Path
from tokenize import TokenError
from typing import IO, NamedTuple
from zipfile import BadZipFile, ZipFile, ZipInfo

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from deltas_nets.errors import UserError

__all__ = ["holds_floats", "read_npy", "read_npy_array", "read_pfm", "unzipped"]

_AGAIN = "copy or export the file again"
_NO_ZIP = (BadZipFile, zlib.error, EOFError, OSError, RuntimeError, NotImplementedError)
"""What Python raises of a file that is none, or a damaged or encrypted one."""


def read_pfm(data: bytes, path: Path) -> NDArray[np.float32]:
    """A grey portable float map; its rows are stored from the bottom up.

    Raises:
        UserError: the file is none, or is truncated.
    """
    head = re.match(
        rb"P([fF])\s+(\d{1,6})\s+(\d{1,6})\s+(-?[0-9.eE+-]{1,20})[ \t\r]*\n", data[:100]
    )
    if head is None or head[1] == b"F":
        raise UserError("the file is no grey PFM image", path, _AGAIN)
    width, height = int(head[2]), int(head[3])
    order = "<" if head[4].startswith(b"-") else ">"
    if len(data) - head.end() != 4 * width * height or not width or not height:
        raise UserError(f"the PFM file is truncated: it claims {width}x{height}", path, _AGAIN)
    values = np.frombuffer(data, order + "f4", offset=head.end()).reshape(height, width)
    return values[::-1].astype(np.float32)


def read_npy(data: bytes, path: Path) -> NDArray[np.float32] | NDArray[np.integer]:
    """A map ``(H, W)``, of float32 or of the whole numbers of the file.

    A third dimension of 1 is left out.

    Raises:
        UserError: as `read_npy_array`, or it is no map.
    """
    array = read_npy_array(data, path)
    kept = array.shape
    if len(kept) == 3 and 1 in (kept[0], kept[2]):
        kept = kept[1:] if kept[0] == 1 else kept[:2]
    if len(kept) != 2:
        raise UserError(f"the NPY file has shape {array.shape}, no map", path, _AGAIN)
    if array.dtype.kind == "b":
        raise UserError("the NPY file holds yes and no, no depth", path, _AGAIN)
    if array.dtype.kind in "iu":
        return array.reshape(kept)  # type: ignore[return-value]
    with np.errstate(over="ignore"):
        return array.reshape(kept).astype(np.float32)


class _Header(NamedTuple):
    shape: tuple[int, ...]
    in_columns: bool
    dtype: np.dtype[np.generic]


def holds_floats(path: Path) -> bool:
    """Whether an NPY or NPZ file holds floats; False where it cannot be read."""
    try:
        with path.open("rb") as file:
            if path.suffix.lower() != ".npz":
                return _header(file, path).dtype.kind == "f"
            with ZipFile(file) as zipped, zipped.open(_depth_in(zipped, path)) as inside:
                return _header(inside, path).dtype.kind == "f"
    except (*_NO_ZIP, UserError):
        return False


def unzipped(data: bytes, path: Path, limit: int) -> bytes:
    """The NPY file inside of an NPZ: the one called depth, or the only one.

    Args:
        data: of the NPZ.
        path: its name.
        limit: bytes that it may have.

    Raises:
        UserError: there is none, or it is damaged, or larger.
    """
    try:
        with ZipFile(BytesIO(data)) as zipped:
            inside = _depth_in(zipped, path)
            if inside.file_size > limit:
                raise UserError(f"the NPZ file holds more than {limit} bytes", path, _AGAIN)
            return zipped.read(inside)
    except _NO_ZIP as error:
        raise UserError("the file is no NPZ, or damaged", path, _AGAIN) from error


def _depth_in(zipped: ZipFile, path: Path) -> ZipInfo:
    arrays = [inside for inside in zipped.infolist() if inside.filename.endswith(".npy")]
    if len(arrays) > 1:
        arrays = [inside for inside in arrays if inside.filename == "depth.npy"]
    if not arrays:
        raise UserError("the NPZ file has no array called depth", path, _AGAIN)
    return arrays[0]


def read_npy_array(data: bytes, path: Path) -> NDArray[np.generic]:
    """Numbers of any shape.

    Raises:
        UserError: the file is no NPY, is truncated, or holds anything but numbers.
    """
    file = BytesIO(data)
    shape, in_columns, dtype = _header(file, path)
    if dtype.kind not in "fiub" or dtype.hasobject or dtype.names is not None:
        raise UserError(f"the NPY file holds {dtype}, not numbers", path, _AGAIN)
    count = 1
    for size in shape:
        count *= size
    if min(shape, default=1) < 0 or count * dtype.itemsize != len(data) - file.tell():
        raise UserError(f"the NPY file is truncated: it claims shape {shape}", path, _AGAIN)
    flat = np.frombuffer(data, dtype, count, file.tell())
    return flat.reshape(shape, order="F" if in_columns else "C")


def _header(file: IO[bytes], path: Path) -> _Header:
    try:
        version = npy.read_magic(file)
        if version == (1, 0):
            return _Header(*npy.read_array_header_1_0(file))
        if version == (2, 0):
            return _Header(*npy.read_array_header_2_0(file))
        raise ValueError("of another version")
    except (ValueError, TypeError, SyntaxError, TokenError, RecursionError) as error:
        raise UserError("the file is no NPY array", path, _AGAIN) from error
