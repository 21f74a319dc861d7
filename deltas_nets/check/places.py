"""Where cameras stand: whether they move, repeat a pose, and whether it is metres."""

import numpy as np

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.ids import ids_in_words
from deltas_nets.check.finding import Fault, Finding
from deltas_nets.check.mending import leaving_out
from deltas_nets.check.units import hardly_metres

__all__ = ["centres_of", "wrong_places"]

STILL = 2e-3  # metres between the farthest cameras
FROZEN = 2  # frames with an earlier frame's pose, from which on it is no accident
STEPS = (3e-6, 30.0)  # metres from a frame to the next, usually


def centres_of(poses: FloatArray) -> FloatArray:
    """``(F, 3)`` where cameras stand."""
    centres: FloatArray = -np.einsum("fij,fi->fj", poses[:, :3, :3], poses[:, :3, 3])
    return centres


def wrong_places(capture: Capture) -> list[Finding]:
    """Standing still, or else poses that repeat and poses that are not in metres."""
    frames = capture.frames
    if len(frames) < 2:
        evidence = "the capture has one frame with a pose"
        return [Finding(Fault.NO_BASELINE, evidence, (), "take more pictures", "error")]
    centres = centres_of(frames.cam_from_world)
    extent = float(np.linalg.norm(np.ptp(centres, axis=0)))
    rounding = 1e-9 * float(abs(centres).max())
    if extent <= max(STILL if capture.metric else 0.0, rounding):
        turn = _widest_turn(frames.cam_from_world)
        evidence = (
            f"all {len(frames)} cameras stand within {1000 * extent:.2g} mm, turned by up to "
            f"{turn:.0f} degrees"
        )
        cure = "take pictures from other places (a few centimetres a metre of distance), or find "
        return [Finding(Fault.NO_BASELINE, evidence, (), cure + "the lost translations", "error")]
    return [*_frozen(capture), *_unit(capture, centres)]


def _widest_turn(poses: FloatArray) -> float:
    cosine = (np.trace(poses[0, :3, :3].T @ poses[:, :3, :3], axis1=1, axis2=2) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1)).max()))


def _frozen(capture: Capture) -> list[Finding]:
    poses = capture.frames.cam_from_world.reshape(len(capture.frames), -1)
    _, first, which = np.unique(poses, axis=0, return_index=True, return_inverse=True)
    repeats = first[which.ravel()] != np.arange(len(poses))
    if repeats.sum() < FROZEN:
        return []
    ids = tuple(capture.frames.kept(repeats))
    evidence = f"{len(ids)} of {len(poses)} frames ({ids_in_words(ids)}) have an earlier frame's "
    cure = f"tracking stood still there: leave out {ids_in_words(ids, 20)}"
    return [Finding(Fault.FROZEN_POSES, evidence + "pose", ids, cure, "warning", leaving_out(ids))]


def _unit(capture: Capture, centres: FloatArray) -> list[Finding]:
    step = float(np.median(np.linalg.norm(np.diff(centres, axis=0), axis=-1)))
    if not capture.metric or step <= STEPS[1]:
        return []
    return [hardly_metres("from a frame to the next the camera moves by", step)]
