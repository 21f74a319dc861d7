"""Depth maps of a small capture as `deltas depth` would have left them, without a network."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.opening import open_capture
from deltas_nets.outputs.folder import prepare_output
from deltas_nets.outputs.products import FrameOutput, OutputOptions
from deltas_nets.page.scene import camera_of

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
        head={"unit": options.unit, "scaled_by": capture.scaled_by},
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
