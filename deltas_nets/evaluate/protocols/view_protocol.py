"""The view sets of a scene by a rule that has a name and a version."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.usable import usable_view_sets
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.evaluate.protocols.deep_video import deep_video_view_sets
from deltas_nets.evaluate.protocols.fixed_gap import fixed_gap_view_sets, gap_of
from deltas_nets.evaluate.some_sets import evenly_spaced
from deltas_nets.outputs.summary import recorded_view_sets

__all__ = ["ProtocolName", "SceneViews", "ViewProtocol"]

ProtocolName = Literal["chosen", "paper", "deepvideomvs"]
VERSION = 1
"""Of all rules; a change that moves a figure raises it."""
USUAL = {"paper": 3, "deepvideomvs": 3}
"""Views where none are asked for: the paper's table 2; two measurement frames."""


class SceneViews(NamedTuple):
    """What is scored of a scene.

    Attributes:
        view_sets: anchors and sources.
        record: the rule's name, version and numbers.
    """

    view_sets: tuple[ViewSet, ...]
    record: dict[str, Any]


class ViewProtocol(NamedTuple):
    """A rule.

    Attributes:
        name: "chosen" as `deltas depth` chooses, unless a file or a run says it; "paper" for
            sequences of a fixed gap; "deepvideomvs" for key frames.
        views: of a set, the anchor among them; as the rule has it if None.
        gap: of "paper", instead of the paper's.
        every: of "paper": anchors are frames whose number it divides.
        file: of view sets, instead of a rule.
        predictions: a folder of `deltas depth` whose own sets count if there is no other rule.
        sets: so many of each scene, spread over all; every one if None.
    """

    name: ProtocolName = "chosen"
    views: int | None = None
    gap: int | None = None
    every: int = 20
    file: Path | None = None
    predictions: Path | None = None
    sets: int | None = None

    def of(self, capture: Capture) -> SceneViews:
        """The view sets of a scene.

        Raises:
            UserError: there are none, or the scene's frames have no numbers where a gap is wanted.
        """
        version: dict[str, Any] = {"version": VERSION}
        if self.name == "paper":
            views = self.views or USUAL["paper"]
            gap = self.gap or gap_of(views)
            sets = fixed_gap_view_sets(capture, views, gap=gap, every=self.every)
            rule = {"views": views, "gap": gap, "anchor": "middle", "anchors_every": self.every}
            return SceneViews(sets, {"name": "paper"} | version | rule)
        if self.name == "deepvideomvs":
            views = self.views or USUAL["deepvideomvs"]
            sets = deep_video_view_sets(capture, views)
            return SceneViews(sets, {"name": "deepvideomvs"} | version | {"views": views})
        if self.file is None and self.predictions is not None:
            sets = recorded_view_sets(self.predictions)
            return SceneViews(sets, {"name": "as predicted"} | version)
        name = "chosen" if self.file is None else "file"
        sets = usable_view_sets(capture, self.file, self.views).view_sets
        return SceneViews(sets, {"name": name} | version | {"views": self.views})

    def some_of(self, view_sets: Sequence[ViewSet], record: dict[str, Any]) -> SceneViews:
        """Of a scene's sets that can be scored, as many as are asked for; the record says so."""
        more = {} if self.sets is None else {"sets": self.sets}
        return SceneViews(tuple(evenly_spaced(view_sets, self.sets)), record | more)
