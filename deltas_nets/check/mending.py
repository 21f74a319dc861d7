"""Changes of a capture that cures are made of: other cameras, fewer frames."""

from collections.abc import Callable, Collection
from dataclasses import replace
from typing import Any

import numpy as np

from deltas_nets.captures.capture import Capture, FloatArray, Lost
from deltas_nets.captures.frames import Frames
from deltas_nets.check.finding import Mend
from deltas_nets.errors import UserError

__all__ = ["changing_frames", "changing_poses", "leaving_out", "scaling_poses"]


def changing_poses(change: Callable[[FloatArray], FloatArray]) -> Mend:
    """A mend by a function of all poses ``(F, 4, 4)``, cam_from_world with the files' axes.

    What went wrong went wrong in the files: a transpose in OpenGL's axes is none in ours.
    """

    def mend(capture: Capture) -> Capture:
        frames, axes = capture.frames, capture.form.axes
        poses = axes @ change(axes @ frames.cam_from_world)
        arrays = frames.arrays._replace(cam_from_world=poses)
        return replace(capture, frames=Frames(frames.folder, arrays, memory=frames.memory))

    return mend


def changing_frames(change: Callable[[int, Any], Any]) -> Mend:
    """A mend by a function that is given the position of a frame and the frame."""

    def mend(capture: Capture) -> Capture:
        changed = [change(*item) for item in enumerate(capture.frames.values())]
        frames = Frames.of(changed, capture.frames.folder)
        if capture.frames.memory is not None:
            frames = frames.remembering(capture.frames.memory)
        return replace(capture, frames=frames)

    return mend


def leaving_out(ids: Collection[str]) -> Mend:
    """A mend by taking frames out."""
    gone = frozenset(ids)

    def mend(capture: Capture) -> Capture:
        mask = np.array([id in gone for id in capture.frames], dtype=np.bool_)
        error = UserError("the frame is left out", capture.path, "see deltas check")
        return capture.without(mask, Lost("listed", error))

    return mend


def scaling_poses(factor: float) -> Mend:
    """A mend that multiplies translations, and sparse points with them; sensor depth stays."""

    def change(poses: FloatArray) -> FloatArray:
        poses[:, :3, 3] *= factor
        return poses

    def mend(capture: Capture) -> Capture:
        points, ranges = capture.points, capture.depth_ranges
        return replace(
            changing_poses(change)(capture),
            points=None if points is None else points._replace(xyz=points.xyz * factor),
            depth_ranges=None if ranges is None else ranges * factor,
        )

    return mend
