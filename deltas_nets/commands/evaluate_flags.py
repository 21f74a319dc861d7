"""Flags of `deltas evaluate` that do nothing without another."""

__all__ = ["without_effect"]


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
