"""PFM and NPY files of floats, read within the bounds of the file's own length, without pickle."""

import re
from io import BytesIO
from pathlib import Path
from tokenize import TokenError

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from deltas_nets.errors import UserError

__all__ = ["read_npy", "read_npy_array", "read_pfm"]

_AGAIN = "copy or export the file again"


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


def read_npy(data: bytes, path: Path) -> NDArray[np.float32]:
    """A map of floats, ``(H, W)``; a third dimension of 1 is left out.

    Raises:
        UserError: as `read_npy_array`, or it is no map.
    """
    array = read_npy_array(data, path)
    kept = array.shape
    if len(kept) == 3 and 1 in (kept[0], kept[2]):
        kept = kept[1:] if kept[0] == 1 else kept[:2]
    if len(kept) != 2:
        raise UserError(f"the NPY file has shape {array.shape}, no map", path, _AGAIN)
    with np.errstate(over="ignore"):
        return array.reshape(kept).astype(np.float32)


def read_npy_array(data: bytes, path: Path) -> NDArray[np.generic]:
    """Numbers of any shape.

    Raises:
        UserError: the file is no NPY, is truncated, or holds anything but numbers.
    """
    file = BytesIO(data)
    try:
        version = npy.read_magic(file)
        if version == (1, 0):
            shape, in_columns, dtype = npy.read_array_header_1_0(file)
        elif version == (2, 0):
            shape, in_columns, dtype = npy.read_array_header_2_0(file)
        else:
            raise ValueError("of another version")
    except (ValueError, TypeError, SyntaxError, TokenError, RecursionError) as error:
        raise UserError("the file is no NPY array", path, _AGAIN) from error
    if dtype.kind not in "fiub" or dtype.hasobject or dtype.names is not None:
        raise UserError(f"the NPY file holds {dtype}, not numbers", path, _AGAIN)
    count = 1
    for size in shape:
        count *= size
    if min(shape, default=1) < 0 or count * dtype.itemsize != len(data) - file.tell():
        raise UserError(f"the NPY file is truncated: it claims shape {shape}", path, _AGAIN)
    flat = np.frombuffer(data, dtype, count, file.tell())
    return flat.reshape(shape, order="F" if in_columns else "C")
