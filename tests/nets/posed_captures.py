"""Captures to draw: poses, cameras, lenses, ids, points, and small images of theirs."""

import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st
from PIL import Image

from deltas_nets.captures.capture import Capture, Frame
from deltas_nets.captures.colmap_model import CAMERA_MODELS
from deltas_nets.captures.frame import FloatArray, Lens
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.points import Observations, SparsePoints
from deltas_nets.captures.rotations import rotations_of

SIZES = ((6, 8), (8, 6), (5, 5))
LENSES = tuple(name for name in CAMERA_MODELS if name != "EQUIRECTANGULAR")
IN_TRANSFORMS = (
    *("SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "SIMPLE_FISHEYE", "FISHEYE"),
    *("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"),
)
"""Lenses that transforms.json has."""
IDS = st.lists(
    st.one_of(
        st.integers(0, 10**6).map(str),
        st.from_regex(r"(cam[0-9]/)?[A-Za-zé][A-Za-z0-9_ é]{0,8}[a-z]", fullmatch=True),
    ),
    min_size=1,
    max_size=4,
    unique_by=str.lower,
)


_FOLDER = tempfile.TemporaryDirectory(prefix="deltas-test-")  # gone when the tests end


@cache
def image_of(size: tuple[int, int]) -> Path:
    """An image of (height, width), the same file each time."""
    path = Path(_FOLDER.name) / f"{size[1]}x{size[0]}.png"
    Image.new("RGB", (size[1], size[0]), (7, 8, 9)).save(path)
    return path


def numbers(low: float, high: float, count: int) -> st.SearchStrategy[FloatArray]:
    drawn = st.lists(st.floats(low, high), min_size=count, max_size=count)
    return drawn.map(np.array)


@st.composite
def rigid(draw: st.DrawFn) -> FloatArray:
    quaternion = draw(numbers(-1, 1, 4).filter(lambda q: float(np.abs(q).max()) > 0.1))
    pose = np.eye(4)
    pose[:3, :3] = rotations_of(quaternion)
    pose[:3, 3] = draw(numbers(-100, 100, 3))
    return pose


@st.composite
def lenses(draw: st.DrawFn, names: tuple[str, ...]) -> Lens | None:
    name = draw(st.sampled_from((None, *names)))
    if name is None:
        return None
    model = CAMERA_MODELS[name]
    bends = tuple(draw(numbers(-0.2, 0.2, model.num_coefficients)).tolist())
    return None if model.straight and not any(bends) else Lens(name, bends)


@st.composite
def sparse_points(draw: st.DrawFn, num_frames: int) -> SparsePoints | None:
    count = draw(st.integers(0, 3))
    if count == 0:
        return None
    pairs = [(point, frame) for point in range(count) for frame in range(num_frames)]
    seen = draw(st.lists(st.sampled_from(pairs), unique=True, max_size=4))
    table = np.array(seen, dtype=np.int64).reshape(-1, 2)
    return SparsePoints(
        draw(numbers(-100, 100, 3 * count)).reshape(-1, 3),
        draw(numbers(0, 255, 3 * count)).astype(np.uint8).reshape(-1, 3),
        draw(numbers(0, 4, count)),
        Observations(table[:, 0], table[:, 1], draw(numbers(0, 5, 2 * len(table))).reshape(-1, 2)),
    )


@st.composite
def captures(
    draw: st.DrawFn,
    lens_names: tuple[str, ...] = LENSES,
    *,
    ids: st.SearchStrategy[list[str]] = IDS,
    one_camera: bool = False,
    **more: Any,
) -> Capture:
    """Captures that any of our formats can hold, with cameras of their own for each frame."""
    frames = []
    for id in draw(ids):
        size = draw(st.sampled_from(SIZES))
        lens = draw(lenses(lens_names))
        fx, fy, cx, cy = draw(numbers(5, 20, 4)) * (1, 1, 0.2, 0.2)
        if lens is not None and CAMERA_MODELS[lens.model].num_focal == 1:
            fy = fx
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
        if one_camera and frames:
            K, size, lens = frames[0].K, frames[0].image_size, frames[0].lens
        frames.append(Frame(id, image_of(size), size, K, draw(rigid()), lens=lens))
    points = draw(sparse_points(len(frames)))
    return Capture(Path(), Frames.of(frames), {}, metric=False, points=points, **more)
