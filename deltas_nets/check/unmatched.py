"""Frames that match none of those around them, though these match each other."""

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.ids import ids_in_words
from deltas_nets.captures.images import orientation_of
from deltas_nets.check.finding import Fault, Finding
from deltas_nets.check.matched import Matched
from deltas_nets.check.mending import leaving_out

__all__ = ["unmatched_frames"]


def unmatched_frames(capture: Capture, matched: Matched) -> list[Finding]:
    """A finding of frames whose images show something else, or the same turned."""
    if not matched.alone:
        return []
    frames = [capture.frames.at(position) for position in matched.alone]
    ids = tuple(frame.id for frame in frames)
    evidence = f"{ids_in_words(ids)}: the frames before and after match each other"
    turned = {
        frame.id: turn
        for frame in frames
        if (turn := orientation_of(frame.image_path, frame.image_span)) != 1
    }
    cure = f"see whether the image is of that frame; else leave out {ids_in_words(ids, 20)}"
    if turned:
        id, turn = next(iter(turned.items()))
        evidence += f"; the EXIF of {id} says that it is to be turned (orientation {turn})"
        cure = f"turn {ids_in_words(turned, 20)} as EXIF says, which is not followed, or leave out "
        cure += ids_in_words(ids, 20)
    return [Finding(Fault.FRAMES_UNMATCHED, evidence, ids, cure, "warning", leaving_out(ids))]
