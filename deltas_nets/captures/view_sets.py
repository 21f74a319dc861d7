"""Which frames are looked at together: read from a file, and checked."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.centres import camera_centres
from deltas_nets.captures.readers.json_file import read_json
from deltas_nets.errors import UserError

__all__ = ["ViewSet", "check_frames", "doubtful_scale", "named_frames", "read_view_sets"]


class ViewSet(NamedTuple):
    """Ids of frames that are looked at together."""

    anchor: str
    """The frame whose depth is wanted."""
    sources: tuple[str, ...]
    """The frames that help, best first."""


def read_view_sets(
    path: str | Path, capture: Capture, *, allow_no_sources: bool = False
) -> tuple[ViewSet, ...]:
    """Read ``[{"anchor": 10, "sources": [8, 12]}, ...]``; ids may be numbers or strings.

    Args:
        path: the JSON file.
        capture: the frames that the ids name.
        allow_no_sources: whether an anchor may stand alone, as it may with sensor depth.

    Raises:
        UserError: the file is missing, not JSON or of another form, or a set cannot be used.
    """
    path = Path(path)
    form = 'write [{"anchor": 10, "sources": [8, 12]}, ...]'
    entries = read_json(path, name="view sets", remedy=form)
    if not isinstance(entries, list):
        raise UserError("the view sets are not a list", path, form)
    if not entries:
        raise UserError("the list of view sets is empty", path, form)

    sets: dict[str, ViewSet] = {}
    for position, entry in enumerate(entries):
        name = f"view set {position + 1} of {len(entries)}"
        if not isinstance(entry, dict) or not entry.keys() >= {"anchor", "sources"}:
            raise UserError(f"{name} is not an object with anchor and sources", path, form)
        if not _is_id(entry["anchor"]):
            what = f"{name} has anchor {entry['anchor']!r}, not the id of a frame"
            raise UserError(what, path, form)
        anchor, sources = str(entry["anchor"]), entry["sources"]
        if not isinstance(sources, list) or not all(map(_is_id, sources)):
            what = f"{name} (anchor {anchor}) has sources that are no list of ids"
            raise UserError(what, path, form)
        sources = [str(source) for source in sources]
        _check_ids(name, anchor, sources, path=path, capture=capture)
        if not sources and not allow_no_sources:
            what = f"{name} (anchor {anchor}) has no sources"
            raise UserError(what, path, "name one source or more, or use sensor depth")
        if anchor in sets:
            what = f"{name} has anchor {anchor}, which an earlier set has too"
            raise UserError(what, path, "keep one of them: outputs are named by the anchor")
        sets[anchor] = ViewSet(anchor, tuple(sources))
    return tuple(sets.values())


def check_frames(
    capture: Capture,
    view_sets: Sequence[ViewSet],
    *,
    with_depth: bool = False,
    report: Callable[[str], None] = lambda _: None,
) -> None:
    """Check every frame that a set names, before anything is computed or written.

    A file is decoded only where its header and its end do not tell that it is whole.

    Args:
        capture: the frames.
        view_sets: what will be used of them.
        with_depth: whether the sensor depth of the anchors will be read too.
        report: called with the id of every checked frame.

    Raises:
        UserError: a frame is missing, its pose is not finite, or its image or depth does not
            decode to the end; the text names the file.
    """
    for id in named_frames(view_sets):
        frame = capture.frame(id)
        if not np.isfinite(frame.cam_from_world).all():
            remedy = "take the frame out of the view sets"
            raise UserError(f"the pose of frame {id} is not finite", frame.image_path, remedy)
        frame.check_image()
        report(id)
    if with_depth:
        for view_set in view_sets:
            capture.frame(view_set.anchor).check_depth()


def named_frames(view_sets: Sequence[ViewSet]) -> list[str]:
    """Every id that the sets name, once, in their order."""
    return list(dict.fromkeys(id for views in view_sets for id in (views.anchor, *views.sources)))


def _is_id(value: object) -> bool:
    whole = isinstance(value, int) and not isinstance(value, bool)
    return whole or (isinstance(value, str) and value != "")


def _check_ids(
    name: str, anchor: str, sources: Sequence[str], *, path: Path, capture: Capture
) -> None:
    if anchor in sources:
        what = f"{name} has its anchor {anchor} among its own sources"
        raise UserError(what, path, "take it out of the sources")
    if len(set(sources)) < len(sources):
        what = f"{name} (anchor {anchor}) names a source twice"
        raise UserError(what, path, "name each source once")
    for id in (anchor, *sources):
        if id in capture.lost:
            raise capture.lost[id].error
        if id not in capture.frames:
            what = f"{name} names frame {id}, which {capture.path} does not have"
            raise UserError(what, path, capture.instead_of(id))


def doubtful_scale(
    capture: Capture, view_sets: Sequence[ViewSet], depth_range: tuple[float, float]
) -> str | None:
    """Words for cameras that stand so near or far that their poses are hardly in metres.

    Args:
        capture: the frames.
        view_sets: that are used.
        depth_range: (near, far) of the search, metres.
    """
    poses = ((id, capture.frame(id).cam_from_world) for id in named_frames(view_sets))
    centres = {id: camera_centres(pose) for id, pose in poses}
    baselines = [
        float(np.linalg.norm(centres[source] - centres[views.anchor]))
        for views in view_sets
        for source in views.sources
    ]
    if not baselines:  # depth from a sensor, to be scored
        return None
    usual, (near, far) = float(np.median(baselines)), depth_range
    if near / 250 <= usual <= far / 2:
        return None
    return (
        f"views that go together stand {usual:.3g} m apart (median), and depth is searched from "
        f"{near:g} to {far:g} m: are the poses in metres? If not, scale their translations"
    )
