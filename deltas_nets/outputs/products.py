"""What is written of a frame: a table of files, and the functions that write them."""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from deltas_nets.captures.frame import Frame
from deltas_nets.captures.ply_vertices import header_of, vertices_of, vertices_type
from deltas_nets.errors import UserError
from deltas_nets.outputs.atomic_files import write_atomically
from deltas_nets.outputs.depth_formats import (
    DEPTH_FORMATS,
    MAX_STEPS,
    MILLIMETRES,
    RUNS,
    DepthFormatName,
    read_depth_png,
    write_depth_png,
)

__all__ = [
    "OWN_UNIT",
    "PRODUCTS",
    "FrameOutput",
    "OutputOptions",
    "Product",
    "check_depth_fits",
    "products_of",
    "read_depth_png",
    "read_points_ply",
    "remarks_on",
    "steps_to",
    "write_confidence_png",
    "write_depth_png",
    "write_points_ply",
]

OWN_UNIT = "the capture's own unit"
"""Where the capture has no metres."""


class FrameOutput(NamedTuple):
    """What is known of a frame when its files are written.

    Attributes:
        anchor: the frame.
        depth: ``(H, W)`` in the capture's unit, 0 where there is none.
        confidence: ``(H, W)`` in [0, 1]; None where the network states none.
        points: ``(N, 3)`` in the capture's world and unit.
        colors: ``(N, 3)`` uint8.
    """

    anchor: Frame
    depth: ArrayLike
    confidence: ArrayLike | None
    points: ArrayLike
    colors: ArrayLike


@dataclass(frozen=True)
class OutputOptions:
    """What all frames of a folder have in common."""

    confidence: bool = True
    """Whether the network states one."""
    depth_scale: float = MILLIMETRES
    """Steps of the depth image in a unit."""
    depth_format: DepthFormatName = "png"
    """Suffix of the files of depth: whole steps in a png, float32 in the others."""
    unit: str = "metre"
    """Of depth and points."""

    def __post_init__(self) -> None:
        if not (self.depth_scale > 0 and math.isfinite(self.depth_scale)):
            raise ValueError(f"--depth-scale must be positive, got {self.depth_scale:g}")

    @property
    def max_depth(self) -> float:
        """The largest depth that the files hold, in the unit."""
        return MAX_STEPS / self.depth_scale if self.depth_format == "png" else math.inf


class Product(NamedTuple):
    """A file of every frame.

    Attributes:
        name: of its folder.
        suffix: of the file.
        write: writes it.
        wanted: whether a folder with these options holds it.
    """

    name: str
    suffix: str
    write: Callable[[Path, FrameOutput, OutputOptions], None]
    wanted: Callable[[OutputOptions], bool] = lambda _: True

    def file(self, folder: Path, id: str) -> Path:
        """Where it is written for a frame."""
        return folder / self.name / f"{id}{self.suffix}"


def _write_depth(
    format: DepthFormatName, path: Path, frame: FrameOutput, options: OutputOptions
) -> None:
    DEPTH_FORMATS[format].write(path, frame.depth, options.depth_scale, options.unit)


def _has_depth(format: DepthFormatName, options: OutputOptions) -> bool:
    return options.depth_format == format


def _write_confidence(path: Path, frame: FrameOutput, options: OutputOptions) -> None:
    assert frame.confidence is not None  # or the folder would not hold this product
    write_confidence_png(path, frame.confidence)


def _write_points(path: Path, frame: FrameOutput, options: OutputOptions) -> None:
    write_points_ply(path, frame.points, frame.colors)


PRODUCTS = (
    *(
        Product("depth", f".{name}", partial(_write_depth, name), partial(_has_depth, name))
        for name in DEPTH_FORMATS
    ),
    Product("confidence", ".png", _write_confidence, lambda options: options.confidence),
    Product("points", ".ply", _write_points),
)


def products_of(options: OutputOptions) -> tuple[Product, ...]:
    """What a folder with these options holds."""
    return tuple(row for row in PRODUCTS if row.wanted(options))


def remarks_on(frame: FrameOutput, options: OutputOptions) -> dict[str, Any]:
    """What the summary says of a frame beside its record.

    That is how many pixels are too far for the depth image, and whether none has any depth.
    """
    far = np.asarray(frame.depth, dtype=np.float64) > options.max_depth
    count = int((far & np.isfinite(frame.depth)).sum())
    remarks: dict[str, Any] = {"saturated_pixels": count} if count else {}
    if not (np.asarray(frame.depth) > 0).any():
        remarks["empty"] = True
    return remarks


def steps_to(far: float) -> float:
    """Steps in a unit, a power of ten, with which depth images reach twice as far as this.

    Example:
        >>> steps_to(10.0), steps_to(0.02), steps_to(5000.0)
        (1000.0, 1000000.0, 1.0)
    """
    return float(10.0 ** math.floor(math.log10(MAX_STEPS / (2 * far))))


def check_depth_fits(depth_range: tuple[float, float], options: OutputOptions) -> None:
    """Whether the depth that is searched can be written.

    Raises:
        UserError: its far end cannot.
    """
    _, far = depth_range
    if far <= options.max_depth or math.isinf(far):
        return
    half = MAX_STEPS / (2 * far)  # networks may see beyond the range
    digits = 10.0 ** math.floor(math.log10(half))
    unit = "m" if options.unit == "metre" else "units"
    raise UserError(
        f"depth/N.png holds up to {options.max_depth:g} {unit}, and depth is searched up to "
        f"{far:g} {unit}",
        "--depth-range",
        f"add --depth-scale {half // digits * digits:g} for coarser steps, --format npz (or tiff, "
        "pfm) for float32, or search less far",
    )


def write_confidence_png(path: Path, probability: ArrayLike) -> None:
    """Write probabilities ``(H, W)`` in [0, 1] as 8-bit 0..255; NaN becomes 0."""
    values = np.nan_to_num(np.asarray(probability, dtype=np.float64), nan=0.0).clip(0, 1)
    image = Image.fromarray(np.rint(255 * values).astype(np.uint8))
    write_atomically(path, lambda file: image.save(file, format="PNG", compress_type=RUNS))


def write_points_ply(path: Path, points: ArrayLike, colors: ArrayLike) -> None:
    """Write points ``(N, 3)`` in metres with colors ``(N, 3)`` uint8 as binary PLY.

    Points that are not finite are left out; viewers stumble over them. Coordinates are float, or
    double where they are too large for it.
    """
    xyz, rgb = np.asarray(points, dtype=np.float64), np.asarray(colors)
    if xyz.ndim != 2 or xyz.shape[1] != 3 or rgb.shape != xyz.shape or rgb.dtype != np.uint8:
        raise ValueError(
            f"points and colors must have shape (N, 3), colors uint8, "
            f"got {xyz.shape} and {rgb.shape} {rgb.dtype}"
        )
    finite = np.isfinite(xyz).all(axis=1)
    xyz, rgb = xyz[finite], rgb[finite]
    vertices = vertices_of(xyz=xyz, rgb=rgb)
    content = header_of(vertices.dtype, len(vertices)) + vertices.tobytes()
    write_atomically(path, lambda file: file.write(content))


def read_points_ply(
    path: Path,
) -> tuple[NDArray[np.float32] | NDArray[np.float64], NDArray[np.uint8]]:
    """Points ``(N, 3)`` and colors ``(N, 3)`` of a file of `write_points_ply`."""
    header, end, body = path.read_bytes().partition(b"end_header\n")
    found = re.search(rb"element vertex (\d+)\nproperty (float|double) x", header)
    count, double = (int(found[1]), found[2] == b"double") if found else (0, False)
    kind = vertices_type("xyz", "rgb", double=double)
    whole = len(body) == count * kind.itemsize
    if header + end != header_of(kind, count) or not whole:
        raise UserError("the file is not one of ours", path, "read it with a PLY library")
    vertices = np.frombuffer(body, dtype=kind, count=count)
    return vertices["xyz"].copy(), vertices["rgb"].copy()
