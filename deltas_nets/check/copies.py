"""Files that are the same image, byte for byte."""

import hashlib
from collections import defaultdict
from pathlib import Path

from deltas_nets.captures.capture import Capture, Frame
from deltas_nets.captures.ids import ids_in_words
from deltas_nets.check.finding import Fault, Finding
from deltas_nets.check.mending import leaving_out

__all__ = ["copied_images", "repeated"]

MOST = 10_000  # files looked at


def copied_images(capture: Capture) -> list[Finding]:
    """A finding that names all but the first of each image's frames."""
    by_size: dict[int, list[Frame]] = defaultdict(list)
    for frame in list(capture.frames.values())[:MOST]:
        if frame.image_span is None:
            by_size[_size(frame.image_path)].append(frame)
    same: dict[bytes, list[str]] = defaultdict(list)
    for size, frames in by_size.items():
        if size > 0 and len(frames) > 1:
            for frame in frames:
                same[_digest(frame.image_path)].append(frame.id)
    return repeated(capture, [ids for ids in same.values() if len(ids) > 1], "the same bytes")


def repeated(capture: Capture, groups: list[list[str]], how: str) -> list[Finding]:
    """The finding of ids whose images are the same."""
    order = {id: position for position, id in enumerate(capture.frames)}
    copies = sorted((id for ids in groups for id in ids[1:]), key=order.__getitem__)
    if not copies:
        return []
    poses = capture.frames.cam_from_world
    differ = sum(
        abs(poses[order[id]] - poses[order[ids[0]]]).max() > 1e-6
        for ids in groups
        for id in ids[1:]
    )
    pairs = "; ".join(f"{ids[1]} is {ids[0]}" for ids in groups[:3])
    evidence = f"{len(copies)} of {len(order)} images repeat another frame's ({how}; {pairs}), "
    evidence += f"{differ} with another pose"
    cure = f"leave out {ids_in_words(copies, 20)}"
    return [
        Finding(
            Fault.DUPLICATE_FRAMES, evidence, tuple(copies), cure, "warning", leaving_out(copies)
        )
    ]


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return -1


def _digest(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, hashlib.sha256).digest()
    except OSError:
        return str(path).encode()
