"""Depth maps of a small capture as `deltas depth` would have left them, without a network."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from deltas_nets.captures.camera_sums import camera_sums
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.opening import open_capture
from deltas_nets.outputs.prepare import prepare_output
from deltas_nets.outputs.products import FrameOutput, OutputOptions
from deltas_nets.outputs.summary import CAMERA_SUMS
from deltas_nets.page.scene import camera_of
from deltas_nets.page.surfaces import Surface

NEAR, FAR = 2.0, 3.0
"""Metres, at the left and at the right of every map; the sensor says 2.5 everywhere."""


def map_of(size: tuple[int, int]) -> np.ndarray:
    """Depth that grows from the left to the right."""
    return np.broadcast_to(np.linspace(NEAR, FAR, size[1]), size)


def write_maps(
    capture: Capture | Path,
    out: Path,
    *,
    options: OutputOptions = OutputOptions(),  # noqa: B008
    depth: Callable[[tuple[int, int]], np.ndarray] = map_of,
) -> Path:
    """Write a map of every frame, whose points are all of its pixels."""
    if isinstance(capture, Path):
        capture = open_capture(capture)
    ids = list(capture.frames)
    folder = prepare_output(
        out,
        settings={
            "capture": {"cameras": capture.fingerprint()},
            "view_sets": [[id, [other for other in ids if other != id][:2]] for id in ids],
        },
        options=options,
        frame_ids=ids,
        head={
            "unit": options.unit,
            "scaled_by": capture.scaled_by,
            "depth_scaled_by": capture.depth_scaled_by,
            CAMERA_SUMS: camera_sums(capture.frames),
        },
    )
    for id in ids:
        frame = capture.frame(id)
        seen = depth(frame.image_size)
        rows, columns = np.indices(seen.shape).reshape(2, -1)
        rays = np.linalg.solve(frame.K, np.stack([columns, rows, np.ones(seen.size)]))
        world_from_cam = camera_of(frame).world_from_cam
        known = seen.ravel() > 0
        points = (world_from_cam[:3, :3] @ (rays * seen.ravel())).T + world_from_cam[:3, 3]
        confidence = np.full(seen.shape, 0.6) if options.confidence else None
        colors = frame.read_image().reshape(-1, 3)
        record = {"status": "ok", "confidence": 0.6, "valid_points": 9, "keypoints": 10}
        folder.write_frame(
            FrameOutput(frame, seen, confidence, points[known], colors[known]), record
        )
    folder.write_summary("complete")
    return out


def mesh_of(folder: Path, corners: int = 40) -> Surface:
    """A wavy sheet of triangles, written as ``deltas fuse`` does."""
    x, y = np.meshgrid(np.linspace(0, 1, corners), np.linspace(0, 1, corners))
    xyz = np.stack([x, y, 0.1 * np.sin(9 * x)], axis=-1).reshape(-1, 3)
    rgb = np.random.default_rng(0).integers(0, 255, xyz.shape, dtype=np.uint8)
    a = np.arange(corners * corners).reshape(corners, corners)
    first = np.stack([a[:-1, :-1], a[1:, :-1], a[:-1, 1:]], axis=-1).reshape(-1, 3)
    second = np.stack([a[:-1, 1:], a[1:, :-1], a[1:, 1:]], axis=-1).reshape(-1, 3)
    faces = np.concatenate([first, second])
    vertices = np.zeros(len(xyz), [("xyz", "<f4", 3), ("normal", "<f4", 3), ("rgb", "u1", 3)])
    vertices["xyz"], vertices["rgb"] = xyz, rgb
    listed = np.zeros(len(faces), [("count", "u1"), ("corners", "<i4", 3)])
    listed["count"], listed["corners"] = 3, faces
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(xyz)}"]
    lines += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    lines += [f"property uchar {name}" for name in ("red", "green", "blue")]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    content = "\n".join([*lines, ""]).encode() + vertices.tobytes() + listed.tobytes()
    folder.mkdir(exist_ok=True)
    (folder / "mesh.ply").write_bytes(content)
    return Surface(vertices["xyz"].astype(np.float64), rgb, faces)
