"""Causes of all cameras of a capture that `diagnose` knows, as findings."""

from collections.abc import Iterator
from typing import NamedTuple

import torch

from deltas_geom import diagnose
from deltas_geom.diagnosis.causes import Cause
from deltas_geom.diagnosis.hypotheses import MENDS
from deltas_geom.diagnosis.results import Diagnosis
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import FloatArray
from deltas_nets.check.finding import Fault, Finding, Mend
from deltas_nets.check.matched import Matched
from deltas_nets.check.mending import changing_frames, changing_poses
from deltas_nets.check.rewrite import with_K
from deltas_nets.check.trying import ENOUGH, Case, Suspect

__all__ = ["diagnosed", "of_all_cameras"]


class _Known(NamedTuple):
    """How a cause of `diagnose` is said of a capture, whose files have our axes.

    Attributes:
        fault: what.
        cure: in words of files.
    """

    fault: Fault
    cure: str


KNOWN = {
    Cause.POSES_INVERTED: _Known(
        Fault.POSES_INVERTED, "invert each pose (or tell the reader that it is world-to-camera)"
    ),
    Cause.OPENGL_AXES: _Known(
        Fault.OPENGL_AXES, "negate the second and third column of each camera-to-world matrix"
    ),
    Cause.OPENGL_WORLD_FROM_CAM: _Known(
        Fault.POSES_INVERTED,
        "invert each pose, then negate the second and third column of camera-to-world "
        "(poses are inverted, with OpenGL's axes)",
    ),
    Cause.ROTATIONS_TRANSPOSED: _Known(
        Fault.ROTATIONS_TRANSPOSED, "transpose the rotation of each world-to-camera matrix"
    ),
    Cause.ROTATIONS_INVERTED: _Known(
        Fault.ROTATIONS_INVERTED,
        "transpose the rotation of each camera-to-world matrix; camera centres stay as they are",
    ),
    Cause.CENTERS_AS_TRANSLATIONS: _Known(
        Fault.CENTERS_AS_TRANSLATIONS,
        "in each world-to-camera matrix write t = -R C, C being what stands there now",
    ),
    Cause.K_TRANSPOSED: _Known(Fault.K_TRANSPOSED, "transpose K: fx 0 cx, 0 fy cy, 0 0 1"),
}
"""Causes of all cameras that need no search."""
OF_OPENGL = {
    Cause.POSES_INVERTED: KNOWN[Cause.POSES_INVERTED]._replace(cure="invert each pose"),
    Cause.OPENGL_AXES: KNOWN[Cause.OPENGL_AXES]._replace(fault=Fault.OPENCV_AXES),
    Cause.OPENGL_WORLD_FROM_CAM: KNOWN[Cause.OPENGL_WORLD_FROM_CAM]._replace(
        cure="invert each pose, then negate the second and third column of camera-to-world "
        "(poses are inverted, with OpenCV's axes)"
    ),
}
"""Those that are said otherwise where files have OpenGL's axes, as every format of such has
camera-to-world matrices."""


def diagnosed(capture: Capture, matched: Matched) -> Diagnosis:
    """What `diagnose` says of the matches."""
    return diagnose(
        matched.views(capture.frames), matched.pixels, mask=matched.seen, threshold=ENOUGH
    )


def of_all_cameras(case: Case) -> Iterator[Suspect]:
    """Causes of all cameras that explain residuals, each judged by what its mend makes of files."""
    said = KNOWN | OF_OPENGL if case.capture.form.opengl else KNOWN
    for cause, known in said.items():
        mend = _mend(cause)
        found = case.mended(mend)
        if found.explains:
            finding = Finding(known.fault, found.in_words, (), known.cure, "error", mend)
            yield Suspect(found, finding)


def _mend(cause: Cause) -> Mend:
    change = MENDS[cause]
    if cause is Cause.K_TRANSPOSED:

        def transposing(capture: Capture) -> Capture:
            right = {index: K.T.copy() for index, K in enumerate(capture.frames.K)}
            return changing_frames(with_K(right))(capture)

        return transposing

    def poses(given: FloatArray) -> FloatArray:
        tensor = torch.from_numpy(given)
        K = torch.eye(3, dtype=torch.float64).expand(len(tensor), 3, 3)
        mended: FloatArray = change(K, tensor)[1].numpy()
        return mended

    return changing_poses(poses)
