"""Metrics as a table for people and as JSON for programs."""

from collections.abc import Mapping
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table

from deltas_nets.evaluate.calibration import Calibration
from deltas_nets.evaluate.depth_metrics import DepthMetrics
from deltas_nets.evaluate.scores import CaptureScores

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


def calibration_table(calibration: Calibration, *, title: str) -> Table:
    """Predicted standard deviation against the error, a row for each tenth of the pixels."""
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD)
    for name in ("pixels", "predicted std", "RMS error", "ratio", "sqrt(2) mean error", "ratio"):
        table.add_column(name, justify="right")
    for number, decile in enumerate(calibration.deciles):
        table.add_row(
            f"{10 * number}-{10 * number + 10} %",
            f"{decile.std:.3f}",
            f"{decile.rms:.3f}",
            f"{decile.rms_ratio:.2f}",
            f"{decile.laplace:.3f}",
            f"{decile.laplace_ratio:.2f}",
        )
    return table


def sparsification_line(calibration: Calibration) -> str:
    """What keeping the certain half does to Abs Rel."""
    found = calibration.sparsification
    return (
        f"Abs Rel of the most certain half: {found.half:.3f} of {found.every:.3f} in each map "
        f"({found.ratio:.2f}), {found.pooled_half:.3f} of {found.pooled_every:.3f} of all pixels "
        f"({found.pooled_ratio:.2f})"
    )


def scores_by_name(scores: CaptureScores) -> dict[str, DepthMetrics]:
    """The columns of a capture's table."""
    rows = {"dense": scores.dense, "median-scaled": scores.median_scaled}
    return rows if scores.sparse is None else rows | {"sparse points": scores.sparse}


def scores_as_json(scores: CaptureScores) -> dict[str, Any]:
    """Everything in a capture's scores, JSON-ready."""
    rows = {name: metrics._asdict() for name, metrics in scores_by_name(scores).items()}
    written: dict[str, Any] = {"metrics": rows, "abs_rel_by_frame": scores.frames}
    if scores.calibration is not None:
        written["calibration"] = _calibration_as_json(scores.calibration)
    return written


def _calibration_as_json(calibration: Calibration) -> dict[str, Any]:
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
