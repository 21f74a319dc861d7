"""Files of depth maps: whole steps in a PNG, or float32 in the capture's unit."""

import zlib
from collections.abc import Callable
from pathlib import Path
from tokenize import TokenError
from typing import IO, Any, Literal, NamedTuple
from zipfile import BadZipFile

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from deltas_nets.captures.float_files import read_pfm
from deltas_nets.errors import UserError
from deltas_nets.outputs.atomic_files import write_atomically

__all__ = [
    "DEPTH_FORMATS",
    "MAKE_ANEW",
    "MAX_STEPS",
    "MILLIMETRES",
    "RUNS",
    "DepthFormat",
    "DepthFormatName",
    "read_depth_map",
    "read_depth_png",
    "write_depth_png",
]

MILLIMETRES = 1000.0  # steps in a metre
MAKE_ANEW = "remove it and run deltas depth again"
"""What is there is kept by `deltas depth`, damaged or not."""
NOT_MADE = "run deltas depth first"
THEIRS = "write ID.png (16-bit millimetres), ID.npz (depth, metres), ID.tiff or ID.pfm (metres)"
"""Of maps of another program."""
MAX_STEPS = 65534  # 65535 means "none" to some readers
RUNS = zlib.Z_RLE
"""How maps are compressed: a sixth of the time of the default, files of 8 % more to 10 % less."""

DepthFormatName = Literal["png", "npz", "tiff", "pfm"]


class DepthFormat(NamedTuple):
    """How depth is written, and read again.

    Attributes:
        write: a file, from ``(H, W)`` in the capture's unit, 0 where there is none, the steps in
            a unit, and the unit's name.
        read: ``(H, W)`` float32 from a file and the steps in a unit.
    """

    write: Callable[[Path, ArrayLike, float, str], None]
    read: Callable[[Path, float], NDArray[np.float32]]


def write_depth_png(
    path: Path, depth: ArrayLike, scale: float = MILLIMETRES, unit: str = "metre"
) -> None:
    """Write ``(H, W)`` metres as 16-bit steps, millimetres if no other scale is given.

    Unknown depth (0, negative, NaN, infinite) becomes 0; known depth stays known: below half
    a step it is written as 1, beyond 65534 steps as that. Scale and unit are in the file's text.
    """
    metres = np.asarray(depth, dtype=np.float64)
    known = np.isfinite(metres) & (metres > 0)
    steps = np.rint(scale * np.where(known, metres, 0)).clip(1, MAX_STEPS)
    image = Image.fromarray(np.where(known, steps, 0).astype(np.uint16))
    text = PngInfo()
    text.add_text("depth_scale", f"{scale:g}")
    text.add_text("unit", unit)
    write_atomically(
        path, lambda file: image.save(file, format="PNG", compress_type=RUNS, pnginfo=text)
    )


def read_depth_png(path: Path, scale: float = MILLIMETRES) -> NDArray[np.float32]:
    """``(H, W)`` float32 metres of a file of `write_depth_png`, 0 where there is none."""
    with Image.open(path) as image:
        if not image.mode.startswith("I"):
            raise ValueError(f"16 bits of one channel are expected, got {image.mode}")
        steps = np.asarray(image)
    single = np.float32(scale)
    if steps.dtype != np.uint16 or float(single) != scale:
        return (steps / np.float64(scale)).astype(np.float32)
    # The same to the last bit, as both are exact in float32, in a third of the memory.
    depth = steps.astype(np.float32)
    return np.divide(depth, single, out=depth)


def _write_npz(path: Path, depth: ArrayLike, scale: float, unit: str) -> None:
    metres, name = np.asarray(depth, dtype=np.float32), np.array(unit)
    write_atomically(path, lambda file: np.savez_compressed(file, depth=metres, unit=name))


def _read_npz(path: Path, scale: float) -> NDArray[np.float32]:
    with np.load(path, allow_pickle=False) as arrays:
        depth: NDArray[np.float32] = arrays["depth"]
    return depth


def _write_tiff(path: Path, depth: ArrayLike, scale: float, unit: str) -> None:
    image = Image.fromarray(np.asarray(depth, dtype=np.float32))
    write_atomically(path, lambda file: image.save(file, format="TIFF", compression="tiff_deflate"))


def _read_tiff(path: Path, scale: float) -> NDArray[np.float32]:
    with Image.open(path) as image:
        return np.asarray(image, dtype=np.float32)


def _write_pfm(path: Path, depth: ArrayLike, scale: float, unit: str) -> None:
    rows = np.asarray(depth, dtype="<f4")[::-1]  # from the bottom to the top

    def write(file: IO[bytes]) -> None:
        file.write(f"Pf\n{rows.shape[1]} {rows.shape[0]}\n-1.0\n".encode())
        file.write(rows.tobytes())

    write_atomically(path, write)


def _read_pfm(path: Path, scale: float) -> NDArray[np.float32]:
    return read_pfm(path.read_bytes(), path)


DEPTH_FORMATS: dict[DepthFormatName, DepthFormat] = {
    "png": DepthFormat(write_depth_png, read_depth_png),
    "npz": DepthFormat(_write_npz, _read_npz),
    "tiff": DepthFormat(_write_tiff, _read_tiff),
    "pfm": DepthFormat(_write_pfm, _read_pfm),
}
"""By the suffix of their files."""
_UNREADABLE = (
    *(OSError, ValueError, KeyError, SyntaxError, EOFError, Image.DecompressionBombError),
    *(BadZipFile, zlib.error, TokenError, RuntimeError, MemoryError),  # of an npz
)
"""What Pillow and NumPy raise where a file is damaged."""


def _one_channel(depth: NDArray[Any]) -> NDArray[np.float32]:
    if depth.ndim != 2 or depth.size == 0:
        raise ValueError(f"its shape must be (H, W), got {depth.shape}")
    if depth.dtype.kind not in "fiu":
        raise ValueError(f"it must hold numbers, got {depth.dtype}")
    return depth.astype(np.float32, copy=False)


def read_depth_map(
    folder: Path, id: str, scale: float, *, ours: bool = True
) -> NDArray[np.float32]:
    """The map of a frame, in whatever format a folder holds it.

    Args:
        folder: that has depth/ID.png, or another format.
        id: of the frame.
        scale: steps in a unit, of PNG.
        ours: whether `deltas depth` wrote it, and can do so again.

    Raises:
        UserError: there is none, there are several, or it cannot be read.
    """
    named = ((folder / "depth" / f"{id}.{name}", kind) for name, kind in DEPTH_FORMATS.items())
    found = [(file, kind) for file, kind in named if file.exists()]
    if not found:
        what = f"no depth map (No such file or directory{_beside(folder / 'depth')})"
        raise UserError(what, folder / "depth" / f"{id}.png", NOT_MADE if ours else THEIRS)
    file, kind = found[0]
    if len(found) > 1:
        names = " and ".join(file.name for file, _ in found)
        raise UserError(f"a frame has several depth maps, {names}", file.parent, "keep one of them")
    try:
        return _one_channel(kind.read(file, scale))
    except _UNREADABLE as error:
        what = f"the depth map cannot be read ({error})"
        raise UserError(what, file, MAKE_ANEW if ours else THEIRS) from error


def _beside(folder: Path) -> str:
    """What is there instead: names of another form, or a suffix that is not read."""
    first = min((file.name for file in folder.iterdir()), default="") if folder.is_dir() else ""
    return f"; {first} is there" if first else ""
