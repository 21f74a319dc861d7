"""Which view sets of a capture can be used, checked before anything is computed or written."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.ids import ids_in_words
from deltas_nets.captures.sets_file import sets_file
from deltas_nets.captures.view_choice import ChosenViews, choose_views
from deltas_nets.captures.view_sets import (
    ViewSet,
    check_frames,
    doubtful_scale,
    named_frames,
    read_view_sets,
)
from deltas_nets.errors import UserError
from deltas_nets.terminal import progress, warn

LEFT_OUT = {False: "a usable pose", True: "an image"}
"""What frames lack, by whether that is their image."""
TRUTH = {"": "add depth/N.png", "Robust MVD": "add key/depth.npy"}
"""What a capture without sensor depth lacks, by its layout; "" is ScanNet's export."""
FEW = 5
"""Views of a set where nobody asks for more or less."""


class UsableViews(NamedTuple):
    """View sets, and how many have fewer views than asked."""

    view_sets: tuple[ViewSet, ...]
    short: int


def usable_view_sets(
    capture: Capture,
    file: Path | None,
    num_views: int | None,
    *,
    working_depth: float | None = None,
    anchors: Sequence[str] | None = None,
) -> UsableViews:
    """The file's view sets, shortened to so many views, the capture's own, or ones that we choose.

    Args:
        capture: the frames.
        file: of view sets, which may lie in the capture, or None.
        num_views: at most so many; as many as there are, or 5 of chosen ones, if not given.
        working_depth: as for `deltas_nets.captures.view_choice.choose_view_sets`.
        anchors: frames that want a set, where no file says it; all if not given.
    """
    if num_views is not None and num_views < 2:
        raise UserError("too few views", f"--views {num_views}", "use 2 or more")
    wanted = num_views or FEW
    if file is not None:
        view_sets = read_view_sets(sets_file(file, capture.path), capture)
        wanted = num_views or 2
    elif capture.sources is not None:
        chosen = tuple(capture.frames) if anchors is None else anchors
        view_sets = _stated(capture, capture.sources, chosen, wanted, working_depth)
    else:
        found = choose_views(capture, wanted, working_depth=working_depth, anchors=anchors)
        view_sets = found.view_sets
        if wanted <= len(capture.frames):
            _tell_of_short(found, wanted)
    most = 1 + max((len(views.sources) for views in view_sets), default=0)
    if num_views is not None and most < num_views:
        warn(f"no map is from {num_views} views: there are at most {most} that go together")
    if file is None or num_views is not None:
        view_sets = tuple(v._replace(sources=v.sources[: wanted - 1]) for v in view_sets)
    return UsableViews(view_sets, sum(len(views.sources) < wanted - 1 for views in view_sets))


def lone_frames(capture: Capture, file: Path | None, anchors: Sequence[str] | None) -> UsableViews:
    """Anchors without sources, for maps that rest on measured depth alone.

    Args:
        capture: the frames.
        file: of view sets, whose anchors are meant, or None; it may lie in the capture.
        anchors: the frames, where no file says it; all if not given.
    """
    if file is not None:
        listed = read_view_sets(sets_file(file, capture.path), capture, allow_no_sources=True)
        anchors = [views.anchor for views in listed]
    chosen = capture.frames if anchors is None else anchors
    return UsableViews(tuple(ViewSet(id, ()) for id in chosen), 0)


def _stated(
    capture: Capture,
    sources: Mapping[str, tuple[str, ...]],
    anchors: Sequence[str],
    num_views: int,
    working_depth: float | None,
) -> tuple[ViewSet, ...]:
    """The capture's own view sets, and chosen ones of frames of which it says nothing."""
    known = {id: tuple(filter(capture.frames.__contains__, sources.get(id, ()))) for id in anchors}
    silent = [id for id in anchors if not known[id] and sources.get(id) != ()]
    if silent:
        ids = ids_in_words(silent)
        warn(f"views are chosen where the capture states none that are there: {ids}")
        found = choose_views(capture, num_views, working_depth=working_depth, anchors=silent)
        _tell_of_short(found, num_views)
        known |= {views.anchor: views.sources for views in found.view_sets}
    if not any(known.values()):
        what = "the capture says of every frame that no view goes with it"
        raise UserError(what, capture.path, "name views with --view-sets")
    return tuple(ViewSet(id, sources) for id, sources in known.items() if sources)


def _tell_of_short(found: ChosenViews, wanted: int) -> None:
    """Warn of sets with fewer views than asked, and say why."""
    count = sum(found.short.values())
    if count:
        why = "; ".join(f"other frames {reason} ({n})" for reason, n in found.short.items())
        sets = f"{count} of {len(found.view_sets)} view sets"
        warn(f"{sets} have fewer than {wanted} views that fit: {why}")


def with_depth_only(capture: Capture, view_sets: tuple[ViewSet, ...]) -> tuple[ViewSet, ...]:
    """The view sets whose anchor has sensor depth."""
    found = tuple(
        views for views in view_sets if capture.frame(views.anchor).depth_path is not None
    )
    if not found:
        remedy = TRUTH.get(capture.layout, "name one in a format that has it: docs/captures.md")
        raise UserError("the capture has no sensor depth", capture.path, remedy)
    if len(found) < len(view_sets):
        warn(f"{len(view_sets) - len(found)} anchors without sensor depth are not scored")
    return found


def check_all(
    capture: Capture, view_sets: tuple[ViewSet, ...], *, with_depth: bool = False
) -> None:
    """Check every file that will be used, before anything is written."""
    with progress("checking images", len(named_frames(view_sets))) as report:
        check_frames(capture, view_sets, with_depth=with_depth, report=report)


def warn_of(
    capture: Capture,
    view_sets: Sequence[ViewSet],
    view_sets_file: Path | None,
    depth_range: tuple[float, float],
) -> None:
    """Warnings of what may be a mistake, and one that names the frames without a pose."""
    for doubt in capture.doubts:
        warn(doubt)
    scale = doubtful_scale(capture, view_sets, depth_range) if capture.metric else None
    if scale is not None:
        warn(scale)
    for reason, words in LEFT_OUT.items() if view_sets_file is None else ():
        ids = [id for id, lost in capture.lost.items() if (lost.reason == "no image") == reason]
        if ids:
            warn(f"frames without {words} are left out: {ids_in_words(ids)}")
