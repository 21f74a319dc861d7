"""Images and depth of a capture, brought to another folder."""

import json
import os
import shutil
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from deltas_nets.captures.capture import Capture, Frame
from deltas_nets.captures.depth_files import MILLIMETRES, holds_floats
from deltas_nets.captures.images import Span, decode, open_span
from deltas_nets.captures.readers.names import DEPTH_SUFFIXES
from deltas_nets.captures.register import register_depth
from deltas_nets.errors import UserError

__all__ = [
    "Placing",
    "PutDepth",
    "Putting",
    "check_no_skew",
    "depth_is_registered",
    "image_name",
    "put_depth",
    "put_image",
    "put_image_as_png",
    "put_registered_depth",
    "write_floats",
    "write_frames_json",
    "write_millimetres",
]

Placing = Literal["copy", "link"]
"""How images come to a folder: copied, or as links to where they are."""


class Putting(NamedTuple):
    """How files come to a folder.

    Attributes:
        placing: copied or linked.
        report: called with the id of every frame whose image is there.
    """

    placing: Placing
    report: Callable[[str], None]


MOST = 65534 / MILLIMETRES
"""Metres that 16 bits of millimetres hold; 65535 means unknown to some."""
_JPEG = b"\xff\xd8"


class PutDepth(NamedTuple):
    """Depth that was brought to a folder: the file, and its steps in a unit."""

    path: Path
    scale: float


class _Source(NamedTuple):
    path: Path
    span: Span | None


def write_frames_json(
    path: Path, root: Mapping[str, object], frames: Iterable[Mapping[str, object]]
) -> None:
    """Write JSON with a line for each frame, at the end of the root's object."""
    head = json.dumps(root, indent=1, allow_nan=False).removesuffix("}").rstrip()
    lines = ",\n".join(f"  {json.dumps(frame, allow_nan=False)}" for frame in frames)
    path.write_text(f'{head},\n "frames": [\n{lines}\n ]\n}}\n', encoding="utf-8")


def image_name(frame: Frame) -> str:
    """The name of a frame's image below a folder of images: its id and a suffix.

    Readers take the suffix away again, so that the id stays.
    """
    if frame.image_span is None:
        return f"{frame.id}{frame.image_path.suffix.lower()}"
    with open_span(frame.image_path, frame.image_span) as file:
        return f"{frame.id}{'.jpg' if file.read(2) == _JPEG else '.png'}"


def put_image(frame: Frame, target: Path, putting: Putting) -> None:
    """Bring the image of a frame to a place, bit by bit as it is.

    Raises:
        UserError: the file is missing.
    """
    source = _Source(frame.image_path, frame.image_span)
    _put(source, target, putting.placing, f"image of {frame.id}")
    putting.report(frame.id)


def put_depth(frame: Frame, target: Path, putting: Putting) -> PutDepth | None:
    """Bring the depth of a frame to a place, as it is.

    Args:
        frame: whose depth.
        target: the place, without suffix.
        putting: how.

    Returns:
        None where the frame has no depth.

    Raises:
        UserError: the file is missing.
    """
    if frame.depth_path is None:
        return None
    suffix = frame.depth_path.suffix.lower()
    if frame.depth_span is not None or suffix not in DEPTH_SUFFIXES:
        return write_millimetres(frame.read_depth(), target, frame)
    if frame.depth_unit != 1 and holds_floats(frame.depth_path):
        return write_floats(frame.read_depth(), target, frame)
    file = target.with_name(target.name + suffix)
    _put(_Source(frame.depth_path, None), file, putting.placing, f"depth of {frame.id}")
    return PutDepth(file, frame.depth_scale)


def put_registered_depth(frame: Frame, target: Path, putting: Putting) -> PutDepth | None:
    """The same for formats without a depth camera: what another saw is moved to the image."""
    if frame.depth_path is None or depth_is_registered(frame):
        return put_depth(frame, target, putting)
    return write_millimetres(register_depth(frame), target, frame)


def write_millimetres(depth: NDArray[np.float32], target: Path, frame: Frame) -> PutDepth:
    """Write depth ``(H, W)`` as 16-bit PNG in thousandths of the capture's unit.

    Raises:
        UserError: it goes beyond 65.5 units.
    """
    if depth.max(initial=0.0) > MOST:
        what = f"depth of {frame.id} goes to {depth.max():g}, 16 bits of millimetres to {MOST:g}"
        remedy = "use --to own, which keeps the files as they are"
        raise UserError(what, frame.depth_path or frame.image_path, remedy)
    file = target.with_name(f"{target.name}.png")
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.round(depth * MILLIMETRES).astype(np.uint16)).save(file)
    return PutDepth(file, MILLIMETRES)


def write_floats(depth: NDArray[np.float32], target: Path, frame: Frame) -> PutDepth:
    """Write depth ``(H, W)`` as floats in the capture's unit, in a file that all programs read."""
    file = target.with_name(f"{target.name}.npy")
    file.parent.mkdir(parents=True, exist_ok=True)
    np.save(file, depth)
    return PutDepth(file, frame.depth_scale)


def _put(source: _Source, target: Path, placing: Placing, name: str) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        if source.span is not None:
            with open_span(source.path, source.span) as file:
                target.write_bytes(file.read())
        elif placing == "link":
            source.path.stat()
            os.symlink(source.path.resolve(), target)
        else:
            shutil.copyfile(source.path, target)
    except FileNotFoundError as error:
        raise UserError(f"the {name} is missing", source.path, "put it back") from error


def depth_is_registered(frame: Frame) -> bool:
    """Whether depth is of the colour camera, at whatever size."""
    if frame.cam_from_depth is not None:
        return False
    if frame.depth_K is None or frame.depth_size is None:
        return frame.depth_K is None or np.allclose(frame.depth_K, frame.K, rtol=0, atol=1e-3)
    (rows, columns), (height, width) = frame.depth_size, frame.image_size
    scale = np.array([columns / width, rows / height])
    expected = frame.K.copy()
    expected[:2] *= scale[:, None]
    expected[:2, 2] += (scale - 1) / 2
    # Half a pixel is what depth of half the size differs by between conventions.
    return bool(np.abs(expected - frame.depth_K).max() < 0.6)


def put_image_as_png(frame: Frame, target: Path, putting: Putting) -> None:
    """Write the image of a frame as PNG, where a format takes no other."""
    target.parent.mkdir(parents=True, exist_ok=True)
    decode(frame.image_path, frame.image_span, remedy="copy it again").convert("RGB").save(target)
    putting.report(frame.id)


def check_no_skew(capture: Capture, format: str) -> None:
    """Refuse pixels that are no rectangles.

    Raises:
        UserError: a K has a number beside the focal length.
    """
    skewed = np.abs(capture.frames.K[:, 0, 1]) > 1e-9 * capture.frames.K[:, 0, 0]
    if skewed.any():
        id = capture.frames.id_at(int(skewed.argmax()))
        what = f"K of frame {id} is skewed ({capture.frames[id].K[0, 1]:g}); {format} cannot say so"
        raise UserError(what, capture.path, "use --to scannet, or undistort the images")
