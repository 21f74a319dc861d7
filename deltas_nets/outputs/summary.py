"""The summaries that `deltas depth` leaves in its folder: what made the files there."""

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from deltas_nets.captures.ids import id_in_json
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.errors import UserError
from deltas_nets.outputs.depth_formats import MILLIMETRES

WRITER = "deltas depth"
"""Stands in summary.json and tells our folders from others."""
SUMMARY = "summary.json"
SCALE = "depth_scale"
"""The setting that is there where a unit has not 1000 steps of a depth image."""
FORMAT = "format"
"""The setting that is there where depth maps are no PNG."""
CAMERA_SUMS = "camera_sums"
"""What tells the cameras of the run from others where rounding alone differs."""
SHARD_SUMMARY = re.compile(r"summary\.\d+-of-\d+\.json")


def shard_summary(out: Path, shard: tuple[int, int]) -> Path:
    """Where one of several runs keeps its own summary."""
    return out / f"summary.{shard[0]}-of-{shard[1]}.json"


def read_summary(path: Path) -> dict[str, Any] | None:
    """A summary of ours; None where there is none."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    if not isinstance(content, dict) or content.get("writer") != WRITER:
        return None
    dicts = all(isinstance(content.get(key), dict) for key in ("settings", "frames"))
    return content if dicts else None


def unfinished(out: Path) -> str | None:
    """What a folder of maps waits for, in words; None if it is complete or records no run."""
    summary = read_summary(out / SUMMARY)
    if summary is None or summary.get("status") == "complete":
        return None
    shards = summary.get("waiting_for")
    if not shards:
        return "the run that fills it has not finished"
    return f"the folder is complete after --shard {', '.join(map(str, shards))}"


def recorded_view_sets(out: Path) -> tuple[ViewSet, ...]:
    """The view sets of the run that filled a folder.

    Raises:
        UserError: no run of `deltas depth` did.
    """
    summary = read_summary(out / SUMMARY)
    if summary is None or "view_sets" not in summary["settings"]:
        raise UserError("no run of deltas depth is recorded", out / SUMMARY, "run it first")
    recorded = summary["settings"]["view_sets"]
    return tuple(ViewSet(str(anchor), tuple(map(str, sources))) for anchor, sources in recorded)


def view_sets_in_json(view_sets: Sequence[ViewSet]) -> list[list[Any]]:
    """View sets as settings hold them, for `recorded_view_sets`."""
    return [[id_in_json(anchor), list(map(id_in_json, sources))] for anchor, sources in view_sets]


def recorded_depth_scale(out: Path) -> float:
    """Steps in a metre of a folder's depth images."""
    summary = read_summary(out / SUMMARY)
    scale: float = MILLIMETRES if summary is None else summary["settings"].get(SCALE, MILLIMETRES)
    return scale


def recorded_pixels(out: Path) -> int | None:
    """Pixels of the images that the network saw, of a run or shard that filled a folder.

    None if there was none, or if a size was asked for.
    """
    shards = sorted(file for file in out.glob("summary.*.json") if SHARD_SUMMARY.match(file.name))
    summaries = filter(None, map(read_summary, (out / SUMMARY, *shards)))
    predict = next(summaries, {}).get("settings", {}).get("predict", {})
    pixels: int | None = predict.get("work_pixels") if predict.get("work_size") is None else None
    return pixels


OPTIONS = {
    "capture": "the capture or one of its cameras",
    "network": "--weights",
    "weights": "--weights",
    "view_sets": "--view-sets (a file's or chosen ones)",
    "work_pixels": "the size of images that a trial found, --work-size",
    "enlarged": "how much small photos are enlarged, --work-size",
    "depth": "what made the maps",
    "cameras": "the capture or one of its cameras",
    "frames": "which frames have depth",
    "deviations": "how far maps may differ",
}
"""What states a setting; of the others an option of the same name does."""


def difference(
    earlier: Mapping[str, Any], wanted: Mapping[str, Any], scaled_by: float | None = None
) -> str:
    """The settings that differ, by the options that state them: ``--views was 3, is 5``.

    Args:
        earlier: the summary of the run before.
        wanted: settings of now.
        scaled_by: what the capture is multiplied with now: cameras differ by that.
    """
    before, after = _flat(earlier["settings"]), _flat(wanted)
    names = sorted(before.keys() | after.keys())
    words: dict[str, str] = {}
    scale = earlier.get("scaled_by")
    if scale is not None and scaled_by is not None and scale != scaled_by:
        words["--scale or --scale-from"] = f"was {scale:.6g}, is {scaled_by:.6g}"
    for name in (name for name in names if before.get(name) != after.get(name)):
        option = OPTIONS.get(name, f"--{name.replace('_', '-')}")
        was, now = json.dumps(before.get(name)), json.dumps(after.get(name))
        short = len(was) + len(now) < 60
        words.setdefault(option, f"was {was}, is {now}" if short else "differs")
    said = [f"{option} {what}" for option, what in words.items()]
    return "; ".join(said[:3]) + (f" and {len(said) - 3} more" if len(said) > 3 else "")


def _flat(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings, those of the prediction among them."""
    inner = settings.get("predict")
    if not isinstance(inner, dict):
        return dict(settings)
    return {**{name: value for name, value in settings.items() if name != "predict"}, **inner}
