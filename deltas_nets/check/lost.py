"""Frames that a capture names and cannot use."""

from dataclasses import replace

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.ids import ids_in_words
from deltas_nets.check.finding import Fault, Finding

__all__ = ["lost_frames"]


def lost_frames(capture: Capture) -> list[Finding]:
    """One finding for lost poses, one for missing images."""
    total = len(capture.frames) + len(capture.lost)
    found = []
    for reason, cause, cure in (
        ("no pose", Fault.POSES_LOST, "track them again, or do without"),
        ("no image", Fault.IMAGES_MISSING, "copy the images to where the capture says they are"),
    ):
        ids = tuple(id for id, lost in capture.lost.items() if lost.reason == reason)
        if ids:
            what = capture.lost[ids[0]].error
            evidence = f"{len(ids)} of {total} frames ({ids_in_words(ids)}): {what.what}"
            cure = f"{cure}; depth is made of the others"
            found.append(Finding(cause, evidence, ids, cure, "warning", _without_lost))
    return found


def _without_lost(capture: Capture) -> Capture:
    return replace(capture, lost={})
