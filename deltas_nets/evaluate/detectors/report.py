"""Table 1 for people and as rows of a record."""

from collections.abc import Mapping, Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table

from deltas_nets.config import to_dict
from deltas_nets.evaluate.detectors.config import TableConfig
from deltas_nets.evaluate.detectors.pairs_file import LIMITS, RelativeScores
from deltas_nets.evaluate.detectors.registry import NamedExtractor
from deltas_nets.evaluate.detectors.scores import DetectorScores
from deltas_nets.evaluate.record import Record, Row, command_line

__all__ = ["detector_rows", "detector_table", "record_of", "relative_rows", "relative_table"]

COLUMNS = {
    "localisation": ("MLE, px", "{:.3f}"),
    "matching": ("MScore", "{:.3f}"),
    "points": ("Num", "{:.0f}"),
    "repeatability": ("Rep", "{:.3f}"),
    "one_to_one": ("Rep, 1:1", "{:.3f}"),
    "rotation": ("rot@5deg", "{:.3f}"),
    "translation": ("trans@5cm", "{:.3f}"),
}
"""The paper's, in its order, and the second way of counting repeated points."""


def detector_table(scores: Mapping[str, DetectorScores], *, title: str) -> Table:
    """Detectors as rows, as table 1 has them."""
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD)
    table.add_column("")
    for heading, _ in COLUMNS.values():
        table.add_column(heading, justify="right")
    for name, found in scores.items():
        table.add_row(name, *(_cell(getattr(found, key), f) for key, (_, f) in COLUMNS.items()))
    return table


def relative_table(scores: Mapping[str, RelativeScores], *, title: str) -> Table:
    """Detectors as rows, on pairs without depth."""
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD)
    table.add_column("")
    for heading in ("Num", "matches"):
        table.add_column(heading, justify="right")
    for what in ("rot", "dir"):
        for limit in LIMITS:
            table.add_column(f"{what}@{limit:g}", justify="right")
    for name, found in scores.items():
        shares = (_cell(share, "{:.3f}") for share in (*found.rotation, *found.direction))
        table.add_row(name, f"{found.points:.0f}", f"{found.matches:.0f}", *shares)
    return table


def detector_rows(scores: Mapping[str, DetectorScores]) -> list[Row]:
    """Rows of a record: detector, then everything in its scores."""
    return [{"detector": name, **found._asdict()} for name, found in scores.items()]


def relative_rows(scores: Mapping[str, RelativeScores]) -> list[Row]:
    """Rows of a record: shares within 5, 10 and 20 degrees under names of their own."""
    rows: list[Row] = []
    for name, found in scores.items():
        row: dict[str, Any] = {"detector": name, **found._asdict()}
        for what in ("rotation", "direction"):
            shares = zip(LIMITS, row.pop(what), strict=True)
            row |= {f"{what}_{limit:g}": share for limit, share in shares}
        rows.append(row)
    return rows


def record_of(
    table: str,
    rows: Sequence[Row],
    extractors: Sequence[NamedExtractor],
    config: TableConfig,
    data: Mapping[str, Any],
) -> Record:
    """What is stored: see :mod:`deltas_nets.evaluate.record`."""
    return Record(
        table,
        protocol=to_dict(config),
        command=command_line(),
        data=[data],
        weights={one.name: one.weights for one in extractors if one.weights},
        rows=rows,
    )


def _cell(value: float, form: str) -> str:
    return "-" if value != value else form.format(value)
