"""What `deltas evaluate` says before it scores: flags that do nothing, scores that mislead."""

from pathlib import Path
from typing import TYPE_CHECKING

from deltas_nets.terminal import counted, warn

if TYPE_CHECKING:
    from deltas_nets.captures.capture import Capture
    from deltas_nets.evaluate.scores import CaptureScores

__all__ = ["warn_of", "warn_of_maps", "without_effect"]

FEW = 0.2
"""Share of pixels that are right, or wrong, within a factor of nearly two."""


def warn_of(name: str, capture: "Capture", maps: Path | None) -> None:
    """Warn where scores of a scene are not what they look like.

    Args:
        name: of the scene.
        capture: with the true depth.
        maps: the folder of maps that are there already, if they are.
    """
    from deltas_nets.outputs.summary import SUMMARY, read_summary, unfinished
    from deltas_nets.outputs.their_capture import in_their_unit

    if not (capture if maps is None else in_their_unit(capture, maps)).metric:
        warn(f"{name}: lengths and --depth-range are in its own unit, not in metres")
    waits = None if maps is None else unfinished(maps)
    if waits is not None:
        warn(f"not all maps of {maps} are there: {waits}")
    said = {} if maps is None else (read_summary(maps / SUMMARY) or {}).get("settings", {})
    if said.get("sensor_depth", {}).get("from") == "sensor":
        warn("the maps were made with the sensor depth that they are scored against")


def warn_of_maps(scores: "CaptureScores") -> None:
    """Warn where maps of any program are empty, or right but for a factor, as of another unit.

    Poses whose scale is off by some per cent do not count.
    """
    empty = [id for id, each in scores.maps.items() if not each.sums.used]
    if empty:
        warn(
            f"{len(empty)} of {counted(len(scores.maps), 'map')} have no depth where the true "
            f"depth is, and count in the coverage alone; the first is {empty[0]}"
        )
    as_they_are, scaled = scores.dense, scores.median_scaled
    if as_they_are.delta3 < FEW and scaled.delta3 > 1 - FEW:
        warn("the maps are right but for a factor: are they in metres, and PNG in millimetres?")


def without_effect(
    *, scannet: bool, rooms: bool, paper: bool, maps: bool, recorded_sets: bool
) -> dict[str, str | None]:
    """By the field of a flag what it goes with, where that is missing.

    Args:
        scannet: whether a folder of ScanNet is scored.
        rooms: whether rooms are.
        paper: whether view sets are those of the paper's protocol.
        maps: whether maps that are there are scored.
        recorded_sets: whether their view sets are those of the run that made them.
    """
    there = "no --predictions, as their maps are there" if maps else None
    return {
        "split": None if scannet else "--data scannet",
        "conditions": None if rooms else "--rooms",
        "gap": None if paper else "--protocol paper",
        "every": None if paper else "--protocol paper",
        "views": "--view-sets or --protocol" if recorded_sets else None,
        "weights": there,
        "precision": there,
        "work_size": there,
    }
