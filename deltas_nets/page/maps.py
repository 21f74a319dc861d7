"""A folder of depth maps together with the capture that they are of."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.ids import ids_in_words
from deltas_nets.errors import UserError
from deltas_nets.outputs.beside import fused_files, read_fuse_summary
from deltas_nets.outputs.confidence_maps import confidence_file, read_confidence
from deltas_nets.outputs.depth_formats import MAKE_ANEW, read_depth_map
from deltas_nets.outputs.products import read_points_ply
from deltas_nets.outputs.summary import recorded_depth_scale
from deltas_nets.outputs.their_capture import METRE, made_of
from deltas_nets.terminal import warn

__all__ = ["Maps", "fused_in", "has_fused", "open_maps"]

FUSED = ("mesh.ply", "cloud.ply")
"""What `deltas fuse` writes."""


class Maps(NamedTuple):
    """Depth maps that `deltas depth` wrote, and where they are seen from.

    Attributes:
        folder: that holds them.
        capture: in the unit of the maps.
        ids: of the frames that have a map, in the order of the capture.
        missing: frames that were to have one.
        summary: what the run recorded.
        steps: of a depth PNG in the unit.
        fused: folder with mesh.ply or cloud.ply; that of the maps if not given.
    """

    folder: Path
    capture: Capture
    ids: tuple[str, ...]
    missing: tuple[str, ...]
    summary: Mapping[str, Any]
    steps: float
    fused: Path

    @property
    def unit(self) -> str:
        """The maps' unit in a word: m, or units where the capture has no metres."""
        return "m" if self.summary.get("unit", METRE) == METRE else "units"

    def record(self, id: str) -> Mapping[str, Any]:
        """What the summary says of a frame; empty where it says nothing."""
        record = self.summary["frames"].get(id)
        return record if isinstance(record, dict) else {}

    def depth(self, id: str) -> NDArray[np.float32]:
        """``(H, W)`` in the capture's unit, 0 where there is none.

        Raises:
            UserError: the file cannot be read.
        """
        depth = read_depth_map(self.folder, id, self.steps)
        return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))

    def confidence(self, id: str) -> NDArray[np.float32] | None:
        """``(H, W)`` in [0, 1]; None where the network stated none.

        Raises:
            UserError: the file cannot be read.
        """
        if not confidence_file(self.folder, id).exists():
            return None
        return read_confidence(self.folder, id).astype(np.float32) / np.float32(255)

    def points(self, id: str) -> tuple[NDArray[np.float64], NDArray[np.uint8]] | None:
        """Points ``(N, 3)`` of a frame's map in the world, and their colours; None without a file.

        Raises:
            UserError: the file cannot be read.
        """
        file = self.folder / "points" / f"{id}.ply"
        if not file.exists():
            return None
        try:
            points, colors = read_points_ply(file)
        except UserError as error:
            raise UserError(error.what, file, MAKE_ANEW) from error
        except (OSError, ValueError) as error:
            what = f"the points cannot be read ({error})"
            raise UserError(what, file, MAKE_ANEW) from error
        return points.astype(np.float64), colors


def has_fused(folder: Path) -> bool:
    """Whether a folder holds what the page shows of `deltas fuse`."""
    return bool(fused_in(folder))


def fused_in(folder: Path) -> list[Path]:
    """What is fused in a folder, the mesh first; of a folder of `deltas fuse` what that made."""
    summary = read_fuse_summary(folder)
    ours = FUSED if summary is None else fused_files(summary)
    return [folder / name for name in FUSED if name in ours and (folder / name).exists()]


def open_maps(capture: Capture, folder: Path, fused: Path | None = None) -> Maps:
    """The maps of a capture; those that are missing are named in a warning.

    Args:
        capture: as it was opened for `deltas depth`, whatever scale it had there.
        folder: that `deltas depth` filled.
        fused: that `deltas fuse` filled, if that is another.

    Raises:
        UserError: the folder is none of `deltas depth`, its maps are of another capture, or there
            is not a single one; or nothing fused is where it is said to be.
    """
    if fused is not None and not has_fused(fused):
        raise UserError(f"there is no {' or '.join(FUSED)}", fused, "run deltas fuse first")
    capture, ids, missing, summary = made_of(capture, folder)
    if missing:
        warn(
            f"{len(missing)} of {len(ids) + len(missing)} maps are missing: {ids_in_words(missing)}"
        )
    steps = recorded_depth_scale(folder)
    return Maps(folder, capture, ids, missing, summary, steps, fused or folder)
