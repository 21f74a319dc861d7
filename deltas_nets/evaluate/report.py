"""Metrics as a table for people and as JSON for programs."""

from collections.abc import Mapping
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table

from deltas_nets.evaluate.capture import CaptureScores
from deltas_nets.evaluate.depth_metrics import DepthMetrics

NAMES = {
    "abs_rel": "Abs Rel",
    "abs_diff": "Abs, m",
    "sq_rel": "Sq Rel, m",
    "rmse": "RMSE, m",
    "rmse_log": "RMSE log",
    "delta1": "delta < 1.25",
    "delta2": "delta < 1.25^2",
    "delta3": "delta < 1.25^3",
    "coverage": "coverage",
}


def metrics_table(columns: Mapping[str, DepthMetrics], *, title: str) -> Table:
    """The paper's metrics, a column for each name: it fits any terminal."""
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD)
    table.add_column("")
    for name in columns:
        table.add_column(name, justify="right")
    for key, label in NAMES.items():
        table.add_row(label, *(f"{getattr(metrics, key):.3f}" for metrics in columns.values()))
    return table


def scores_by_name(scores: CaptureScores) -> dict[str, DepthMetrics]:
    """The columns of a capture's table."""
    rows = {"dense": scores.dense, "median-scaled": scores.median_scaled}
    return rows if scores.sparse is None else rows | {"sparse points": scores.sparse}


def scores_as_json(scores: CaptureScores) -> dict[str, Any]:
    """Everything in a capture's scores, JSON-ready."""
    rows = {name: metrics._asdict() for name, metrics in scores_by_name(scores).items()}
    return {"metrics": rows, "abs_rel_by_frame": scores.frames}
