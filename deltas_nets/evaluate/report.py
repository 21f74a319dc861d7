"""Metrics as tables for people."""

import math
from collections.abc import Mapping

from rich.box import SIMPLE_HEAD
from rich.table import Table

from deltas_nets.evaluate.calibration import Calibration
from deltas_nets.evaluate.consistency import Consistency
from deltas_nets.evaluate.dataset import DatasetScores
from deltas_nets.evaluate.depth_metrics import DepthMetrics
from deltas_nets.evaluate.scores import CaptureScores

NAMES = {
    "abs_rel": "Abs Rel",
    "abs_diff": "Abs",
    "sq_rel": "Sq Rel",
    "rmse": "RMSE",
    "rmse_log": "RMSE log",
    "delta1": "delta < 1.25",
    "delta2": "delta < 1.25^2",
    "delta3": "delta < 1.25^3",
    "delta105": "delta < 1.05",
    "delta103": "delta < 1.03",
    "coverage": "coverage",
}
LENGTHS = ("abs_diff", "sq_rel", "rmse")
"""Metrics with a unit, which is the metre where captures know it."""


def metrics_table(columns: Mapping[str, DepthMetrics], *, title: str, metric: bool = True) -> Table:
    """The paper's metrics, a column for each name: it fits any terminal."""
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD)
    table.add_column("", no_wrap=True)
    for name in columns:
        table.add_column("\n".join(name.rsplit(" ", 1)), justify="right")
    for key, label in NAMES.items():
        label += _unit(metric) if key in LENGTHS else ""
        table.add_row(label, *(_number(getattr(metrics, key)) for metrics in columns.values()))
    return table


def scenes_table(scores: DatasetScores, *, title: str) -> Table:
    """A row a scene, and one of all: frames, those that failed, and the metrics most looked at."""
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD)
    table.add_column("scene", overflow="fold")
    metric = scores.total.metric
    for name in ("frames", "failed", "Abs Rel", f"Abs{_unit(metric)}", "delta\n< 1.25", "coverage"):
        table.add_column(name, justify="right")
    for name, scene in {**scores.scenes, "all": scores.total}.items():
        shown = ("abs_rel", "abs_diff", "delta1", "coverage")
        numbers = (_number(getattr(scene.dense, key)) for key in shown)
        table.add_row(name, str(len(scene.maps)), str(len(scene.failed)), *numbers)
    for name in scores.failed:
        table.add_row(name, "0", "all", *4 * ("",))
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


def consistency_line(found: Consistency) -> str:
    """What maps of a scene say of each other."""
    return (
        f"pixels that agree to 5 % with a neighbouring map: {_number(found.agreement)}, of the "
        f"true depth {_number(found.truth)} ({found.pairs} pairs); flicker of successive maps "
        f"{_number(found.flicker, 4)} ({found.successive} pairs)"
    )


def scores_by_name(scores: CaptureScores) -> dict[str, DepthMetrics]:
    """The columns of a capture's table."""
    rows = {
        "dense": scores.dense,
        "pooled": scores.pooled,
        "median-scaled": scores.median_scaled,
        "scale and shift": scores.fitted,
    }
    return rows if scores.sparse is None else rows | {"sparse points": scores.sparse}


def _unit(metric: bool) -> str:
    return ", m" if metric else ", units"


def _number(value: float | None, digits: int = 3) -> str:
    """As tables have it; a dash for what could not be measured."""
    return "-" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"
