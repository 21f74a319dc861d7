"""The capture that a folder of depth maps was made of."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from deltas_geom.checks import check_kind
from deltas_nets.captures.camera_sums import are_sums_of
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.ids import ids_in_words
from deltas_nets.captures.scaled import scaled
from deltas_nets.errors import UserError
from deltas_nets.outputs.depth_formats import DEPTH_FORMATS
from deltas_nets.outputs.summary import (
    CAMERA_SUMS,
    SUMMARY,
    read_summary,
    recorded_view_sets,
)

__all__ = ["METRE", "MadeOf", "in_their_unit", "made_of", "map_file"]

METRE = "metre"


class MadeOf(NamedTuple):
    """What finished maps were made of.

    Attributes:
        capture: in the unit of the maps.
        ids: of the frames that have a map, in the order of the capture.
        missing: frames that were to have one.
        summary: what the run recorded.
    """

    capture: Capture
    ids: tuple[str, ...]
    missing: tuple[str, ...]
    summary: Mapping[str, Any]


def made_of(capture: Capture, folder: Path) -> MadeOf:
    """The capture as the maps know it.

    Args:
        capture: as it was opened for `deltas depth`, whatever scale it had there.
        folder: that `deltas depth` filled.

    Raises:
        UserError: the folder is none of `deltas depth`, its maps are of another capture, or there
            is not a single one.
    """
    check_kind("capture", capture, Capture, "open_capture(PATH)")
    anchors = [views.anchor for views in recorded_view_sets(folder)]
    summary = read_summary(folder / SUMMARY) or {}
    capture = _as_recorded(capture, folder, summary)
    wanted = set(anchors)
    known = [id for id in capture.frames if id in wanted]
    if not known:
        what = f"the capture has none of the frames of the maps ({ids_in_words(anchors)})"
        raise UserError(what, folder, "name the capture that the maps were made of")
    ids = tuple(id for id in known if map_file(folder, id))
    if not ids:
        raise UserError("there is no depth map", folder / "depth", "run deltas depth first")
    missing = tuple(id for id in known if not map_file(folder, id))
    return MadeOf(capture, ids, missing, summary)


def map_file(folder: Path, id: str) -> Path | None:
    """The file of a frame's map, of any format; None where there is none."""
    files = (folder / "depth" / f"{id}.{name}" for name in DEPTH_FORMATS)
    return next(filter(Path.exists, files), None)


def in_their_unit(capture: Capture, folder: Path) -> Capture:
    """The capture in the unit of a folder's maps, if `deltas depth` made them.

    Args:
        capture: as it was opened for `deltas depth`, whatever scale it had there.
        folder: of maps.
    """
    return _scaled_as_recorded(capture, read_summary(folder / SUMMARY) or {})


def _scaled_as_recorded(capture: Capture, summary: Mapping[str, Any]) -> Capture:
    factor = summary.get("scaled_by", 1.0)
    if not (isinstance(factor, int | float) and factor > 0 and factor != capture.scaled_by):
        return capture
    metric = summary.get("unit", METRE) == METRE
    depth = summary.get("depth_scaled_by", 1.0) / capture.depth_scaled_by
    return scaled(capture, factor / capture.scaled_by, depth_factor=depth, metric=metric)


def _as_recorded(capture: Capture, folder: Path, summary: Mapping[str, Any]) -> Capture:
    capture = _scaled_as_recorded(capture, summary)
    recorded = summary["settings"].get("capture")
    cameras = recorded.get("cameras") if isinstance(recorded, dict) else None
    same = cameras is None or cameras == capture.fingerprint()
    # The capture in another format is the same, too: its numbers are rounded otherwise.
    if not same and not are_sums_of(summary.get(CAMERA_SUMS), capture.frames):
        raise UserError(
            "the maps are of other cameras than the capture has",
            folder / SUMMARY,
            "name the capture that they were made of, with the same --intrinsics",
        )
    return capture
