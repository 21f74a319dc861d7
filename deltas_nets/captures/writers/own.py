"""A capture in our own format: frames.json, images/, and depth/ and points.csv where known."""

from pathlib import Path

import numpy as np

from deltas_nets.captures.capture import Capture, Frame
from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.ids import id_in_json
from deltas_nets.captures.points import SparsePoints
from deltas_nets.captures.readers.own_points import OBSERVATIONS, POINTS
from deltas_nets.captures.readers.own_table import VERSION
from deltas_nets.captures.writers.files import (
    Putting,
    check_no_skew,
    image_name,
    put_depth,
    put_image,
    write_frames_json,
)

__all__ = ["write"]


def write(capture: Capture, folder: Path, putting: Putting) -> list[str]:
    """Write everything; see `deltas_nets.captures.writers` for the contract."""
    check_no_skew(capture, "our own format")
    cameras = {f"{index}": _camera(frame) for index, frame in enumerate(_first_of_each(capture))}
    root: dict[str, object] = {
        "version": VERSION,
        "units": "metres" if capture.metric else "unknown",
        "pixel_centres": "integers",
        "cameras": cameras,
    }
    if capture.points is not None:
        root |= _put_points(capture.points, folder)
    frames = [_frame(capture, index, folder, putting) for index in range(len(capture.frames))]
    write_frames_json(folder / "frames.json", root, frames)
    return []


def _first_of_each(capture: Capture) -> list[Frame]:
    """A frame of each camera."""
    _, first = np.unique(capture.frames.arrays.camera_of, return_index=True)
    return [capture.frames.at(int(position)) for position in first]


def _camera(frame: Frame) -> dict[str, object]:
    height, width = frame.image_size
    camera = {**_numbers(frame.K), "width": width, "height": height}
    if frame.lens is not None:
        camera |= {"lens": frame.lens.model, "coefficients": list(frame.lens.coefficients)}
    return camera


def _numbers(K: FloatArray) -> dict[str, object]:
    places = {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}
    return {name: float(K[place]) for name, place in places.items()}


def _frame(capture: Capture, index: int, folder: Path, putting: Putting) -> dict[str, object]:
    frame = capture.frames.at(index)
    name = f"images/{image_name(frame)}"
    put_image(frame, folder / name, putting)
    said: dict[str, object] = {
        "id": id_in_json(frame.id),
        "image": name,
        "camera": str(capture.frames.arrays.camera_of[index]),
        "cam_from_world": frame.cam_from_world.tolist(),
    }
    depth = put_depth(frame, folder / "depth" / frame.id, putting)
    if depth is not None:
        said["depth"] = depth.path.relative_to(folder).as_posix()
        said["depth_scale"] = depth.scale
        if frame.depth_K is not None or frame.cam_from_depth is not None:
            said["depth_camera"] = _depth_camera(frame)
    if capture.depth_ranges is not None:
        said["depth_range"] = capture.depth_ranges[index].tolist()
    if capture.sources is not None and frame.id in capture.sources:
        said["sources"] = [id_in_json(id) for id in capture.sources[frame.id]]
    return said


def _depth_camera(frame: Frame) -> dict[str, object]:
    camera = _numbers(frame.K if frame.depth_K is None else frame.depth_K)
    if frame.depth_size is not None:
        camera |= {"width": frame.depth_size[1], "height": frame.depth_size[0]}
    if frame.cam_from_depth is not None:
        camera["cam_from_depth"] = frame.cam_from_depth.tolist()
    return camera


def _put_points(points: SparsePoints, folder: Path) -> dict[str, object]:
    """Write points and who sees them, each number with all its digits."""
    table = np.concatenate([points.xyz, points.rgb, points.error[:, None]], axis=1)
    _write_table(folder / "points.csv", POINTS, table)
    seen = points.seen
    if not len(seen.point):
        return {"points": "points.csv"}
    rows = np.concatenate([np.stack([seen.point, seen.frame], axis=1), seen.pixels], axis=1)
    _write_table(folder / "observations.csv", OBSERVATIONS, rows)
    return {"points": "points.csv", "observations": "observations.csv"}


def _write_table(path: Path, names: tuple[str, ...], table: FloatArray) -> None:
    with path.open("w", encoding="utf-8", newline="\n") as file:
        np.savetxt(file, table, fmt="%.17g", delimiter=",", header=",".join(names), comments="")
