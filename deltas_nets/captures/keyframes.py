"""Frames of a video that see something new."""

import numpy as np

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.centres import camera_centres
from deltas_nets.captures.working_depth import working_depths

__all__ = ["keyframes"]

FAR_ENOUGH = 0.05  # in working depths
TURNED_ENOUGH = np.radians(8)


def keyframes(capture: Capture, *, working_depth: float | None = None) -> list[str]:
    """Ids, in order: a frame is new if its camera moved or turned enough since the last one.

    Args:
        capture: the frames, in the order in which they were taken.
        working_depth: how far surfaces are; as the capture knows if not given.
    """
    poses = capture.frames.cam_from_world
    centres = camera_centres(poses)
    depths = working_depths(capture) if working_depth is None else [working_depth] * len(poses)
    chosen: list[int] = []
    for number, (pose, centre) in enumerate(zip(poses, centres, strict=True)):
        if chosen:
            last = chosen[-1]
            turn = np.arccos(
                np.clip((np.trace(pose[:3, :3] @ poses[last, :3, :3].T) - 1) / 2, -1, 1)
            )
            moved = float(np.linalg.norm(centre - centres[last])) / depths[last]
            if moved < FAR_ENOUGH and turn < TURNED_ENOUGH:
                continue
        chosen.append(number)
    return [capture.frames.id_at(number) for number in chosen]
