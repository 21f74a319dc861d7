"""Files of sensor depth that cannot be read as depth."""

import numpy as np

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.ids import ids_in_words
from deltas_nets.check.finding import Fault, Finding
from deltas_nets.errors import UserError

__all__ = ["unreadable_depth"]

MOST = 24
"""Files that are looked at: what is wrong with depth is wrong with most of it."""


def unreadable_depth(capture: Capture) -> list[Finding]:
    """A finding of files that commands which need depth would refuse."""
    measured = np.flatnonzero([frame.depth_path is not None for frame in capture.frames.values()])
    some = measured[:: max(1, -(-len(measured) // MOST))].tolist()
    broken: dict[str, UserError] = {}
    for position in some:
        frame = capture.frames.at(position)
        try:
            frame.check_depth()
        except UserError as error:
            broken[frame.id] = error
    if not broken:
        return []
    first = next(iter(broken.values()))
    evidence = f"that of {len(broken)} of {len(some)} frames looked at ({ids_in_words(broken)}): "
    evidence += f"{first.what}, {first.where}"
    return [Finding(Fault.DEPTH_UNREADABLE, evidence, tuple(broken), first.remedy, "warning")]
