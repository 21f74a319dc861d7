"""OpenEXR files of depth: scan lines of floats, stored, run-length coded or deflated.

Tiles, deep pixels, several parts, and wavelet and lossy compression are refused by name. Nothing
is allocated before the file's own length and a limit on the image's size allow it.

Source: OpenEXR file layout, openexr.com/en/latest/OpenEXRFileLayout.html.
"""

import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deltas_nets.errors import UserError

__all__ = ["ExrHeader", "read_exr", "read_exr_header"]

_MAGIC = b"\x76\x2f\x31\x01"
_REMEDY = "write depth as half or float scan lines with ZIP compression, or as 16-bit PNG"
_LINES = {0: 1, 1: 1, 2: 1, 3: 16}
"""Scan lines in a chunk, of the compressions that are read: none, run lengths, ZIPS, ZIP."""
_COMPRESSIONS = ("none", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB")
_TYPES = (np.dtype("<u4"), np.dtype("<f2"), np.dtype("<f4"))
_DEPTH_NAMES = ("Z", "Y", "depth.Z", "depth.V", "A", "V", "R")
"""Which of several channels is depth, best first."""
_HEADER_LIMIT = 2**20
_PIXEL_LIMIT = 2**27


class _Channel(NamedTuple):
    name: str
    type: np.dtype


class ExrHeader(NamedTuple):
    """What an EXR file says before its pixels.

    Attributes:
        size: (height, width).
        channels: in the order in which a scan line holds them.
        lines: scan lines in a chunk.
        compression: its number.
        end: bytes before the table of chunks.
    """

    size: tuple[int, int]
    channels: tuple[_Channel, ...]
    lines: int
    compression: int
    end: int

    @property
    def num_chunks(self) -> int:
        """How many chunks the image is cut into."""
        return -(-self.size[0] // self.lines)

    @property
    def line_bytes(self) -> int:
        """Bytes of a scan line once it is unpacked."""
        return self.size[1] * sum(channel.type.itemsize for channel in self.channels)


def read_exr(data: bytes, path: Path) -> NDArray[np.float32]:
    """The channel of depth.

    Args:
        data: the whole file.
        path: it came from, for errors.

    Returns:
        ``(H, W)``, as stored: not finite where the file says so.

    Raises:
        UserError: the file is no EXR, is damaged, or is of a kind that is not read.
    """
    header = read_exr_header(data, path)
    height, width = header.size
    names = [channel.name for channel in header.channels]
    wanted = next((name for name in _DEPTH_NAMES if name in names), names[0])
    place = names.index(wanted)
    before = sum(channel.type.itemsize for channel in header.channels[:place]) * width
    type = header.channels[place].type
    try:
        table = np.frombuffer(data, "<u8", header.num_chunks, header.end)
    except ValueError as error:
        raise UserError("the EXR file is truncated", path, "copy the file again") from error
    # The first scan line's number need not be 0.
    top = min((_chunk(data, offset, path)[0] for offset in table.tolist()), default=0)
    image = np.full((height, width), np.nan, dtype=np.float32)
    for offset in table.tolist():
        y, packed = _chunk(data, offset, path)
        first = y - top
        if not 0 <= first < height or first % header.lines:
            raise UserError("the EXR file is damaged", path, "copy the file again")
        count = min(header.lines, height - first)
        lines = _unpack(packed, count * header.line_bytes, header, path)
        values = np.frombuffer(lines, np.uint8).reshape(count, header.line_bytes)
        part = values[:, before : before + width * type.itemsize]
        image[first : first + count] = np.ascontiguousarray(part).view(type)
    return image


def read_exr_header(data: bytes, path: Path) -> ExrHeader:
    """Size, channels and compression.

    Raises:
        UserError: as `read_exr`.
    """
    if data[:4] != _MAGIC or len(data) < 8:
        raise UserError("the file is no OpenEXR image", path, _REMEDY)
    (version,) = struct.unpack_from("<I", data, 4)
    if version & 0xFF != 2 or version & 0x1A00:
        raise UserError("the EXR file holds tiles, deep pixels or several parts", path, _REMEDY)
    attributes, end = _attributes(data, path)
    try:
        channels = _channels(attributes["channels"])
        left, top, right, bottom = struct.unpack("<4i", attributes["dataWindow"])
        (compression,) = attributes["compression"]
    except (KeyError, ValueError, IndexError, struct.error) as error:
        raise UserError("the EXR file has a damaged header", path, "copy the file again") from error
    if compression not in _LINES:
        name = dict(enumerate(_COMPRESSIONS)).get(compression, str(compression))
        raise UserError(f"the EXR file is compressed by {name}", path, _REMEDY)
    height, width = bottom - top + 1, right - left + 1
    if not channels or height < 1 or width < 1 or height * width > _PIXEL_LIMIT:
        raise UserError(f"the EXR file claims to have {width}x{height} pixels", path, _REMEDY)
    header = ExrHeader((height, width), channels, _LINES[compression], compression, end)
    # Deflation makes 1032 bytes of one at most: what is larger is not in the file.
    if header.line_bytes * height > 1100 * len(data):
        raise UserError("the EXR file is truncated", path, "copy the file again")
    return header


def _attributes(data: bytes, path: Path) -> tuple[Mapping[str, bytes], int]:
    found: dict[str, bytes] = {}
    place = 8
    damaged = UserError("the EXR file has a damaged header", path, "copy the file again")
    while place < min(len(data), _HEADER_LIMIT):
        if data[place] == 0:
            return found, place + 1
        name, place = _text(data, place, damaged)
        _, place = _text(data, place, damaged)
        if place + 4 > len(data):
            break
        (length,) = struct.unpack_from("<I", data, place)
        found[name] = data[place + 4 : place + 4 + length]
        place += 4 + length
    raise damaged


def _text(data: bytes, start: int, damaged: UserError) -> tuple[str, int]:
    end = data.find(0, start, start + 256)
    if end < 0:
        raise damaged
    return data[start:end].decode("latin-1"), end + 1


def _channels(value: bytes) -> tuple[_Channel, ...]:
    found = []
    place = 0
    while value[place] != 0:
        end = value.index(0, place)
        type, _, across, down = struct.unpack_from("<iIii", value, end + 1)
        if (across, down) != (1, 1) or not 0 <= type < len(_TYPES):
            raise ValueError("a channel is not read")
        found.append(_Channel(value[place:end].decode("latin-1"), _TYPES[type]))
        place = end + 17
    return tuple(found)


def _chunk(data: bytes, offset: int, path: Path) -> tuple[int, memoryview]:
    if offset + 8 > len(data):
        raise UserError("the EXR file is truncated", path, "copy the file again")
    y, length = struct.unpack_from("<iI", data, offset)
    packed = memoryview(data)[offset + 8 : offset + 8 + length]
    if len(packed) < length:
        raise UserError("the EXR file is truncated", path, "copy the file again")
    return y, packed


def _unpack(packed: memoryview, length: int, header: ExrHeader, path: Path) -> bytes:
    damaged = UserError("the EXR file is damaged", path, "copy the file again")
    # What compression would make larger is stored as it is.
    if header.compression == 0 or len(packed) == length:
        stored = bytes(packed)
    else:
        try:
            shuffled = (
                _run_lengths(packed, length)
                if header.compression == 1
                else zlib.decompressobj().decompress(packed, length)
            )
        except (zlib.error, IndexError) as error:
            raise damaged from error
        if len(shuffled) != length:
            raise damaged
        stored = _restored(shuffled)
    if len(stored) != length:
        raise damaged
    return stored


def _run_lengths(packed: memoryview, length: int) -> bytes:
    out = bytearray()
    place = 0
    while place < len(packed) and len(out) <= length:
        (count,) = struct.unpack_from("b", packed, place)
        if count < 0:
            out += packed[place + 1 : place + 1 - count]
            place += 1 - count
        else:
            out += bytes((packed[place + 1],)) * (count + 1)
            place += 2
    return bytes(out)


def _restored(shuffled: bytes) -> bytes:
    """Undo what OpenEXR does before deflation: differences, and even and odd bytes apart."""
    values = np.frombuffer(shuffled, np.uint8).copy()
    values[1:] -= 128
    values = np.cumsum(values, dtype=np.uint8)
    half = -(-len(values) // 2)
    joined = np.empty_like(values)
    joined[0::2] = values[:half]
    joined[1::2] = values[half:]
    return joined.tobytes()
