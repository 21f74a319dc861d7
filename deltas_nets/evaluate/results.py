"""Scores as files: a record of results, and a spreadsheet with a row a frame."""

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch

from deltas_nets.evaluate.calibration import Calibration
from deltas_nets.evaluate.dataset import DatasetScores
from deltas_nets.evaluate.record import Record, Row, finite, machine, write_record
from deltas_nets.evaluate.report import scores_by_name
from deltas_nets.evaluate.scores import CaptureScores, MapScores
from deltas_nets.outputs.atomic_files import write_atomically

__all__ = [
    "METRICS_VERSION",
    "How",
    "frame_rows",
    "scene_rows",
    "scores_as_json",
    "write_csv",
    "write_scores",
]

METRICS_VERSION = 1
"""Of the metrics and of how they are averaged; a change that moves a figure raises it."""


class How(NamedTuple):
    """What made scores, for their record.

    Attributes:
        protocol: what decides the figures besides data, views and weights.
        command: that measures it again.
        weights: of the networks, by name.
        device: of torch.
    """

    protocol: Mapping[str, Any]
    command: str
    weights: Mapping[str, Mapping[str, Any]]
    device: str


def scene_rows(scores: DatasetScores) -> list[Row]:
    """A row for each scene and each way of scoring it, and for all scenes together ("all").

    "dense", "median-scaled", "scale and shift" and "sparse points" are means over frames, "pooled"
    is over the pixels of all of them.
    """
    together = {"all": scores.total} if len(scores.scenes) + len(scores.failed) > 1 else {}
    rows: list[Row] = []
    for name, scene in {**scores.scenes, **together}.items():
        counts = {"frames": len(scene.maps), "failed": len(scene.failed)}
        for way, metrics in scores_by_name(scene).items():
            more = {"ause": scene.ause} if way == "dense" else {}
            rows.append({"scene": name, "scores": way, **counts, **metrics._asdict(), **more})
    for name, why in scores.failed.items():
        rows.append({"scene": name, "scores": "dense", "frames": 0, "note": why})
    return rows


def frame_rows(scores: DatasetScores) -> list[Row]:
    """A row for each anchor: its sources, what became of it, and its metrics in every way."""
    rows: list[Row] = []
    for name, scene in scores.scenes.items():
        sources = {views.anchor: views.sources for views in scores.views[name].view_sets}
        ids = sources or dict.fromkeys([*scene.maps, *scene.without_truth], ())
        for id in ids:
            head: dict[str, Any] = {"scene": name, "frame": id, "sources": " ".join(ids[id])}
            if id in scene.maps:
                rows.append(head | {"status": "ok", "note": None} | _columns(scene.maps[id]))
            elif id in scene.failed:
                rows.append(head | {"status": "failed", "note": scene.failed[id]})
            else:
                note = "no true depth is in range"
                rows.append(head | {"status": "without truth", "note": note})
    return [finite(row) for row in rows]


def _columns(score: MapScores) -> dict[str, Any]:
    ways = {
        "": score.dense,
        "median_": score.scaled,
        "scale_shift_": score.fitted,
        "sparse_": score.sparse,
    }
    found = {
        f"{way}{metric}": value
        for way, metrics in ways.items()
        if metrics is not None
        for metric, value in metrics._asdict().items()
    }
    return found | {"ause": score.ause}


def write_csv(path: Path, scores: DatasetScores) -> None:
    """Write a row for each anchor, comma-separated, atomically; what is not known stays empty.

    Raises:
        UserError: the system refuses.
    """
    rows = frame_rows(scores)
    names = list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: row[name] for name in row if row[name] is not None} for row in rows)
    write_atomically(path, lambda file: file.write(text.getvalue().encode("utf-8")))


def write_scores(path: Path, scores: DatasetScores, how: How) -> None:
    """Write a record of results, and beside its table all that is known of scenes and frames.

    Raises:
        UserError: the system refuses.
    """
    rules = {name: views.record for name, views in scores.views.items()}
    counts = {name: len(views.view_sets) for name, views in scores.views.items()}
    record = Record(
        table="depth",
        protocol={"views": next(iter(rules.values())), **how.protocol},
        command=how.command,
        data=[
            {"name": name, "view_sets": counts.get(name, 0) or len(scores.scenes[name].maps)}
            for name in scores.scenes
        ],
        weights=how.weights,
        rows=scene_rows(scores),
        machine={**machine(how.device), "threads": torch.get_num_threads()},
    )
    scenes = {
        name: {"views": rules[name]} | scores_as_json(scene)
        for name, scene in scores.scenes.items()
    }
    beside = {"frames": frame_rows(scores), "scenes": scenes, "failed_scenes": dict(scores.failed)}
    write_record(path, record, beside=scores_as_json(scores.total) | beside)


def scores_as_json(scores: CaptureScores) -> dict[str, Any]:
    """Everything in a capture's scores, JSON-ready."""
    rows = {name: metrics._asdict() for name, metrics in scores_by_name(scores).items()}
    written: dict[str, Any] = {"metrics": rows, "abs_rel_by_frame": scores.frames}
    if not scores.metric:
        written["unit"] = "the capture's own"
    if scores.ause is not None:
        written["ause"] = scores.ause
    if scores.calibration is not None:
        written["calibration"] = _calibration_as_json(scores.calibration)
    if scores.consistency is not None:
        written["consistency"] = scores.consistency._asdict()
    if scores.failed:
        written["failed"] = scores.failed
    return written


def _calibration_as_json(calibration: Calibration) -> Mapping[str, Any]:
    found = calibration.sparsification
    return {
        "pixels": calibration.pixels,
        "abs_rel_of_all": found.every,
        "abs_rel_of_certain_half": found.half,
        "half_over_all": found.ratio,
        "pooled_abs_rel_of_all": found.pooled_every,
        "pooled_abs_rel_of_certain_half": found.pooled_half,
        "pooled_half_over_all": found.pooled_ratio,
        "deciles": [
            decile._asdict()
            | {"rms_ratio": decile.rms_ratio, "laplace_ratio": decile.laplace_ratio}
            for decile in calibration.deciles
        ],
    }
