"""A capture as transforms.json, which nerfstudio and instant-ngp read."""

from pathlib import Path

import numpy as np

from deltas_nets.captures.capture import Capture, Frame
from deltas_nets.captures.depth_files import MILLIMETRES, holds_floats
from deltas_nets.captures.frame import Lens
from deltas_nets.captures.ply_vertices import header_of, vertices_of
from deltas_nets.captures.points import SparsePoints
from deltas_nets.captures.readers.poses import OPENGL
from deltas_nets.captures.writers.files import (
    PutDepth,
    Putting,
    check_no_skew,
    depth_is_registered,
    image_name,
    put_image,
    put_registered_depth,
    write_floats,
    write_frames_json,
    write_millimetres,
)
from deltas_nets.errors import UserError

__all__ = ["write"]

_NAMES = {
    "SIMPLE_RADIAL": ("OPENCV", ("k1",)),
    "RADIAL": ("OPENCV", ("k1", "k2")),
    "OPENCV": ("OPENCV", ("k1", "k2", "p1", "p2")),
    "FULL_OPENCV": ("OPENCV", ("k1", "k2", "p1", "p2", "k3")),
    "SIMPLE_FISHEYE": ("OPENCV_FISHEYE", ()),
    "FISHEYE": ("OPENCV_FISHEYE", ()),
    "SIMPLE_RADIAL_FISHEYE": ("OPENCV_FISHEYE", ("k1",)),
    "RADIAL_FISHEYE": ("OPENCV_FISHEYE", ("k1", "k2")),
    "OPENCV_FISHEYE": ("OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")),
    "EQUIRECTANGULAR": ("EQUIRECTANGULAR", ()),
}
"""By COLMAP's name: the one of transforms.json, and its names of the coefficients."""


def write(capture: Capture, folder: Path, putting: Putting) -> list[str]:
    """Write the file, images/ and depth/; see `deltas_nets.captures.writers` for the contract."""
    check_no_skew(capture, "transforms.json")
    for camera in capture.frames.arrays.cameras:
        _lens(camera.lens, capture.path)
    scale = _scale(capture)
    root: dict[str, object] = {
        # Ours: others leave it alone, and without it no reader knows.
        "units": "metres" if capture.metric else "unknown",
        "depth_unit_scale_factor": 1 / scale,
    }
    said = []
    if capture.points is not None:
        _write_ply(capture.points, folder / "sparse_points.ply")
        root["ply_file_path"] = "sparse_points.ply"
        said.append(
            "which frame sees which sparse point is left out: the format has no place for it"
        )
    frames = [_frame(frame, folder, putting, scale) for frame in capture.frames.values()]
    write_frames_json(folder / "transforms.json", root, frames)
    return said


def _scale(capture: Capture) -> float:
    """Of all depth, as the file has one: floats, which it goes for, too, are in the unit itself."""
    stored = [frame for frame in capture.frames.values() if frame.depth_path is not None]
    scales = {1.0 if _holds_floats(frame) else frame.depth_scale for frame in stored}
    return scales.pop() if len(scales) == 1 else MILLIMETRES


def _holds_floats(frame: Frame) -> bool:
    return frame.depth_path is not None and holds_floats(frame.depth_path)


def _frame(frame: Frame, folder: Path, putting: Putting, scale: float) -> dict[str, object]:
    name = f"images/{image_name(frame)}"
    put_image(frame, folder / name, putting)
    height, width = frame.image_size
    said: dict[str, object] = {
        "file_path": name,
        "w": width,
        "h": height,
        "fl_x": float(frame.K[0, 0]),
        "fl_y": float(frame.K[1, 1]),
        "cx": float(frame.K[0, 2]) + 0.5,
        "cy": float(frame.K[1, 2]) + 0.5,
        **_lens(frame.lens, frame.image_path),
        "transform_matrix": (np.linalg.inv(frame.cam_from_world) * OPENGL).tolist(),
    }
    depth = _put_depth(frame, folder / "depth" / frame.id, putting, scale)
    if depth is not None:
        said["depth_file_path"] = depth.path.relative_to(folder).as_posix()
    return said


def _put_depth(frame: Frame, target: Path, putting: Putting, scale: float) -> PutDepth | None:
    """Depth at the steps that the file states of all, which is what most have already."""
    steps = 1.0 if _holds_floats(frame) else frame.depth_scale
    as_it_is = steps == scale and frame.depth_span is None
    if frame.depth_path is None or (as_it_is and depth_is_registered(frame)):
        if frame.depth_path is not None and frame.depth_path.suffix.lower() == ".npz":
            return write_floats(frame.read_depth(), target, frame)  # nerfstudio reads no NPZ
        return put_registered_depth(frame, target, putting)
    if scale != MILLIMETRES:
        what = f"depth has {scale:g} steps in a unit, and some must be written anew"
        raise UserError(what, frame.depth_path, "use --to own")
    return (
        write_millimetres(frame.read_depth(), target, frame)
        if depth_is_registered(frame)
        else put_registered_depth(frame, target, putting)
    )


def _lens(lens: Lens | None, path: Path) -> dict[str, object]:
    if lens is None:
        return {"camera_model": "OPENCV"}
    name, keys = _NAMES.get(lens.model, ("", ()))
    rest = lens.coefficients[len(keys) :]
    if not name or any(rest):
        what = f"transforms.json has no lens like {lens.model} {' '.join(map(str, rest))}".rstrip()
        raise UserError(what, path, "use --to own or colmap, or undistort the images")
    return {"camera_model": name, **dict(zip(keys, lens.coefficients, strict=False))}


def _write_ply(points: SparsePoints, path: Path) -> None:
    table = vertices_of(double=True, xyz=points.xyz, rgb=points.rgb)
    path.write_bytes(header_of(table.dtype, len(table)) + table.tobytes())
