"""A measured series as a table, a figure and a record."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.box import SIMPLE_HEAD
from rich.table import Table

from deltas_nets.ablations.measure import METRICS, Measured
from deltas_nets.ablations.paper import PAPER, SPARSE_RATIO, PaperRow
from deltas_nets.ablations.steps import Series
from deltas_nets.evaluate.record import Record, command_line, machine
from deltas_nets.outputs.atomic_files import write_atomically

__all__ = ["ON_SCANNET", "draw_series", "record_of", "series_tables", "with_paper"]

ON_SCANNET = "the paper (ScanNet)"
"""Stands for the weights in rows that the paper reports."""
COLUMNS = {
    "abs_rel": "AbsRel",
    "abs_diff": "Abs",
    "sq_rel": "SqRel",
    "delta1": "d1",
    "sparse_abs_rel": "points",
    "sparse_delta1": "d1",
    "gmacs": "GMACs",
}
"""So few and short that they fit a terminal: d1 is the share within 1.25, "points" the Abs Rel of
triangulated ones; the record has all."""


def series_tables(series: Series, rows: Sequence[Mapping[str, Any]]) -> list[Table]:
    """A table for each network, and the paper's; the steps are rows."""
    by_weights: dict[str, list[Mapping[str, Any]]] = {str(row["weights"]): [] for row in rows}
    for row in rows:
        by_weights[str(row["weights"])].append(row)
    return [_table(series, found, weights) for weights, found in by_weights.items()]


def _table(series: Series, rows: Sequence[Mapping[str, Any]], weights: str) -> Table:
    shown = {k: v for k, v in COLUMNS.items() if any(row.get(k) is not None for row in rows)}
    title = weights or "whatever the network"
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    table.add_column(series.name, no_wrap=True)
    for heading in shown.values():
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        figures = ("-" if row.get(key) is None else _figure(key, row[key]) for key in shown)
        table.add_row(str(row["step"]), *figures)
    return table


def with_paper(series: Series, rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The rows, and what the paper reports of the same series."""
    values = {step.name: step.value for step in series.steps}
    sparse = {row.step: row for row in SPARSE_RATIO} if series.name == "ratio" else {}
    told: list[dict[str, Any]] = []
    for row in PAPER.get(series.name, ()):
        head = {"weights": ON_SCANNET, "step": row.step, "value": values.get(row.step)}
        told.append(head | _paper(row, "") | _paper(sparse.get(row.step), "sparse_"))
    return [*map(dict, rows), *told]


def record_of(
    series: Series,
    measured: Measured,
    *,
    kind: str,
    protocol: Mapping[str, Any],
    data: Mapping[str, Any],
    device: str,
) -> Record:
    """What is stored: the rows, those of the paper among them.

    Args:
        series: what was changed.
        measured: its rows.
        kind: "ablation" or "robustness".
        protocol: what decides the figures.
        data: what they are of.
        device: of torch.
    """
    return Record(
        f"{kind} {series.name}",
        protocol={
            "changed": series.title,
            "axis": series.axis,
            "source": series.source,
            **protocol,
        },
        command=command_line(),
        data=[data],
        weights=measured.weights,
        rows=with_paper(series, measured.rows),
        machine=machine(device),
    )


def draw_series(path: Path, series: Series, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write a PNG: Abs Rel and the share within 1.25, of every network and of the paper.

    Raises:
        UserError: the system refuses.
    """
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 2)
    figure.suptitle(series.title)
    measured = [row for row in rows if row.get("abs_rel") is not None]
    for axis, key, label in zip(
        axes, ("abs_rel", "delta1"), ("Abs Rel", "share within 1.25"), strict=True
    ):
        if not series.axis:
            _draw_bars(axis, measured, key, label)
            continue
        for weights in dict.fromkeys(str(row["weights"]) for row in measured):
            own = [row for row in measured if row["weights"] == weights]
            _draw(axis, own, key, weights, series)
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
    if axes[0].get_legend_handles_labels()[0]:
        axes[0].legend(fontsize="small")
    write_atomically(path, lambda file: figure.savefig(file, format="png", dpi=120))


def _figure(key: str, value: float) -> str:
    return f"{value:.1f}" if key == "gmacs" else f"{value:.4f}"


def _draw_bars(axis: Any, rows: Sequence[Mapping[str, Any]], key: str, label: str) -> None:
    """Values that belong to no axis, the first one on top."""
    names = [f"{row['weights']}\n{row['step']}".strip() for row in rows]
    colors = ["tab:orange" if row["weights"] == ON_SCANNET else "tab:blue" for row in rows]
    axis.barh(names, [row[key] for row in rows], color=colors)
    axis.invert_yaxis()
    axis.tick_params(labelsize=7)
    axis.set_xlabel(label)


def _draw(
    axis: Any, rows: Sequence[Mapping[str, Any]], key: str, weights: str, series: Series
) -> None:
    """Values along an axis as a line, what has none as lines across or bars."""
    style = "--" if weights == ON_SCANNET else "-"
    x_key = "gmacs" if series.name == "architecture" else "value"
    placed = [row for row in rows if row.get(x_key) is not None]
    if placed:
        x = [row[x_key] for row in placed]
        joined = style if x_key == "value" else "none"
        axis.plot(x, [row[key] for row in placed], ls=joined, marker="o", ms=4, label=weights)
        axis.set_xlabel(series.axis)
        if series.logarithmic:
            axis.set_xscale("log")
    for row in rows:
        if row.get(x_key) is None:
            axis.axhline(row[key], ls=":", lw=1, color="grey")
            name = f"{weights} {row['step']}".strip()
            axis.annotate(name, (0.02, row[key]), xycoords=("axes fraction", "data"), fontsize=7)


def _paper(row: PaperRow | None, prefix: str) -> dict[str, Any]:
    if row is None:
        return {}
    figures = {f"{prefix}{name}": getattr(row, name) for name in METRICS}
    return figures if row.gmacs is None else figures | {"gmacs": row.gmacs}
