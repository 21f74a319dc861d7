"""The paper's sequences: so many frames at a fixed gap, the anchor in their middle."""

import numpy as np

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.config.scannet import ScanNetConfig
from deltas_nets.datasets.view_rules import ByGap
from deltas_nets.errors import UserError

__all__ = ["fixed_gap_view_sets", "gap_of"]


def gap_of(num_views: int) -> int:
    """Frames from one view to the next, as in the paper's tables 2 and 3.

    Example:
        >>> [gap_of(views) for views in (2, 3, 4, 5, 7)]
        [20, 20, 15, 12, 10]
    """
    return ScanNetConfig().gap_of(num_views)


def fixed_gap_view_sets(
    capture: Capture, num_views: int, *, gap: int, every: int
) -> tuple[ViewSet, ...]:
    """The sets whose frames are all there and have a pose.

    Args:
        capture: whose frames have numbers for ids, in the order in which they were taken.
        num_views: the anchor and its sources.
        gap: from one view to the next, in frame numbers. The paper does not say which view is the
            anchor: here the middle one, of an even number the later of the two.
        every: anchors are frames whose number it divides; the paper does not say it. It is the same
            for all lengths, so that they are scored at the same anchors, but for the ends of a
            scene.

    Raises:
        UserError: ids are no numbers, or no frame has all its sources.
    """
    # Nanoseconds since 1970 are below 2^63.
    if not all(id.isascii() and id.isdigit() and int(id) < 2**63 for id in capture.frames):
        what = "frames without numbers have no gap between them"
        raise UserError(what, capture.path, "use --protocol chosen, or name --view-sets")
    rule, frames = ByGap(gap, num_views), capture.frames
    numbers = frames.numbers
    if len(np.unique(numbers)) < len(frames):
        raise UserError("two frames have one number", capture.path, "use --protocol chosen")
    anchors = [int(place) for place in rule.anchors(frames) if numbers[place] % every == 0]
    if not anchors:
        what = f"no frame that {every} divides has {rule.in_words()}"
        raise UserError(what, capture.path, "use another --gap, --every or --views")
    return tuple(
        ViewSet(
            frames.id_at(place),
            tuple(frames.id_at(source) for source in rule.sources(frames, place)),
        )
        for place in anchors
    )
