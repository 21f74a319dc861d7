"""Which view sets of a capture can be used, checked before anything is computed or written."""

from collections.abc import Sequence
from pathlib import Path

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.ids import ids_in_words
from deltas_nets.captures.view_choice import choose_view_sets
from deltas_nets.captures.view_sets import (
    ViewSet,
    check_frames,
    doubtful_scale,
    named_frames,
    read_view_sets,
)
from deltas_nets.errors import UserError
from deltas_nets.terminal import progress, warn


def usable_view_sets(
    capture: Capture, file: Path | None, num_views: int | None
) -> tuple[ViewSet, ...]:
    """The file's view sets, shortened to so many views, or ones that we choose."""
    if num_views is not None and num_views < 2:
        raise UserError("too few views", f"--views {num_views}", "use 2 or more")
    if file is None:
        view_sets = choose_view_sets(capture, num_views or 5)
    else:
        view_sets = read_view_sets(file, capture)
    if num_views is None:
        return view_sets
    most = 1 + max(len(views.sources) for views in view_sets)
    if most < num_views:
        warn(f"no map is from {num_views} views: there are at most {most} that go together")
    return tuple(views._replace(sources=views.sources[: num_views - 1]) for views in view_sets)


def with_depth_only(capture: Capture, view_sets: tuple[ViewSet, ...]) -> tuple[ViewSet, ...]:
    """The view sets whose anchor has sensor depth."""
    found = tuple(
        views for views in view_sets if capture.frame(views.anchor).depth_path is not None
    )
    if not found:
        raise UserError("the capture has no sensor depth", capture.path, "add depth/N.png")
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
    for doubt in (*capture.doubts, doubtful_scale(capture, view_sets, depth_range)):
        if doubt is not None:
            warn(doubt)
    if capture.lost and view_sets_file is None:
        warn(f"frames without a usable pose are left out: {ids_in_words(capture.lost)}")
