"""The summary of a folder that several runs fill at once, each with every N-th frame."""

from pathlib import Path
from typing import Any

from deltas_nets.outputs.atomic_files import write_json
from deltas_nets.outputs.summary import SUMMARY, read_summary, shard_summary

__all__ = ["write_shard_summary"]

_Parts = dict[int, dict[str, Any]]


def write_shard_summary(out: Path, shard: tuple[int, int], content: dict[str, Any]) -> None:
    """Write the summary of a shard, and that of all shards.

    Args:
        out: the folder.
        shard: which of how many.
        content: what this shard knows.
    """
    write_json(shard_summary(out, shard), content)
    # Others may finish between our reading and our writing. Who writes last reads once
    # more, so the summary that stays has seen everything.
    parts = _parts(out, shard[1], content)
    while True:
        write_json(out / SUMMARY, _merged(out, shard[1], content, parts))
        seen, parts = parts, _parts(out, shard[1], content)
        if seen == parts:
            return


def _parts(out: Path, count: int, own: dict[str, Any]) -> _Parts:
    """Summaries of the shards that work with our settings, by number."""
    read = {
        index: read_summary(shard_summary(out, (index, count))) for index in range(1, count + 1)
    }
    return {
        index: part
        for index, part in read.items()
        if part is not None and part["settings"] == own["settings"]
    }


def _merged(out: Path, count: int, own: dict[str, Any], parts: _Parts) -> dict[str, Any]:
    earlier = read_summary(out / SUMMARY)
    frames: dict[str, Any] = {}
    if earlier is not None and earlier["settings"] == own["settings"]:
        frames |= earlier["frames"]
    for part in parts.values():
        frames |= part["frames"]
    statuses = {index: part["status"] for index, part in parts.items()}
    missing = [index for index in range(1, count + 1) if statuses.get(index) != "complete"]
    if not missing:
        return own | {"status": "complete", "frames": frames}
    waiting = [f"{index}/{count}" for index in missing]
    status = "running" if "running" in statuses.values() else "stopped"
    return own | {"status": status, "waiting_for": waiting, "frames": frames}
