"""Frames that help other frames' maps, and have none of their own: theirs are heard too."""

from collections.abc import Collection, Sequence

import numpy as np

from deltas_nets.captures.capture import Capture, Lost
from deltas_nets.captures.view_choice import choose_view_sets
from deltas_nets.captures.view_sets import ViewSet, named_frames
from deltas_nets.errors import UserError

__all__ = ["companions"]


def companions(
    capture: Capture,
    view_sets: Sequence[ViewSet],
    *,
    working_depth: float | None = None,
    elsewhere: Collection[str] = (),
) -> tuple[ViewSet, ...]:
    """View sets of the sources that are no anchors, of no other frames than these sets name.

    Args:
        capture: the frames.
        view_sets: whose maps are wanted.
        working_depth: as for `deltas_nets.captures.view_choice.choose_view_sets`.
        elsewhere: frames whose maps another run makes, which have no set either.
    """
    anchors = {*elsewhere, *(views.anchor for views in view_sets)}
    named = named_frames(view_sets)
    wanted = [id for id in capture.frames if id in named and id not in anchors]
    if not wanted:
        return ()
    most = 1 + max(len(views.sources) for views in view_sets)
    others = np.array([id not in named for id in capture.frames], dtype=np.bool_)
    why = UserError("no view set names the frame", capture.path, "name it in one")
    among = capture.without(others, Lost("listed", why))
    return choose_view_sets(among, most, working_depth=working_depth, anchors=wanted)
