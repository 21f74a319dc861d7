"""What `deltas ablate` and `deltas robustness` share: one thing changed, step by step."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import tyro

from deltas_nets.commands.command import Command
from deltas_nets.commands.flags import Flag, sensible
from deltas_nets.commands.values import at_least_one, not_empty, not_negative
from deltas_nets.extras import usable_device
from deltas_nets.terminal import counted, progress, table_console

if TYPE_CHECKING:
    from deltas_nets.ablations.steps import Series


@dataclass(frozen=True)
class MeasuredSeries(Command):
    """A command that measures a series of steps and goes on where it was stopped."""

    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = field(kw_only=True)
    """Folder for NAME.json, NAME.png and NAME.jsonl, which remembers what is done."""
    weights: tuple[str, ...] = ("deltas-small",)
    """Networks: shipped names, files of `deltas train`, the published checkpoint, baselines."""
    view_sets: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """JSON: [{"anchor": 10, "sources": [8, 12]}, ...]; chosen if not given."""
    views: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Views of a set, the anchor included; 3 (the paper) if not given, 8 for the curve of views."""
    sets: Annotated[int, tyro.conf.arg(metavar="N")] = 12
    """So many view sets, spread over all."""
    depth_range: Annotated[tuple[float, float], tyro.conf.arg(metavar="NEAR FAR")] = (0.5, 10.0)
    """Nearest and farthest depth searched and scored, metres."""
    work_size: Annotated[tuple[int, int] | None, tyro.conf.arg(metavar="HEIGHT WIDTH")] = None
    """What the network sees; chosen to suit it if not given."""
    seed: int = 0
    """Of all that is drawn at random."""
    device: str = "auto"
    """Where to compute: auto, cpu, cuda, cuda:1, mps."""
    debug: Flag = False
    """Show the traceback of an error."""

    going_on: ClassVar[str] = "start it again; what is done is kept"
    checks: ClassVar = {
        "sets": at_least_one,
        "seed": not_negative,
        "weights": not_empty,
    }

    def measured(self, series: "Series", path: Path, *, kind: str, num_views: int) -> None:
        """Measure a series, print and write it.

        Args:
            series: what is changed.
            path: the capture.
            kind: "ablation" or "robustness".
            num_views: of a set, where the flag says nothing.
        """
        from deltas_nets.ablations.journal import Journal
        from deltas_nets.ablations.measure import Measurement, measure
        from deltas_nets.ablations.report import draw_series, record_of, series_tables
        from deltas_nets.captures.opening import open_capture
        from deltas_nets.captures.usable import (
            check_all,
            usable_view_sets,
            with_depth_only,
        )
        from deltas_nets.evaluate.record import write_record
        from deltas_nets.evaluate.some_sets import evenly_spaced
        from deltas_nets.outputs.atomic_files import check_writable
        from deltas_nets.predict.depth_map import PredictConfig

        config = sensible(PredictConfig, depth_range=self.depth_range, work_size=self.work_size)
        check_writable(self.out)
        device = usable_device(self.device)
        capture = open_capture(path).remembering()
        usable = usable_view_sets(capture, self.view_sets, self.views or num_views).view_sets
        view_sets = tuple(evenly_spaced(with_depth_only(capture, usable), self.sets))
        check_all(capture, view_sets, with_depth=True)
        measurement = Measurement(capture, view_sets, config, self.seed)
        total = len(self.weights) * len(series.steps)
        with progress(series.name, total) as report:
            found = measure(
                series,
                self.weights,
                measurement,
                Journal(self.out / f"{series.name}.jsonl"),
                device=device,
                report=report,
            )
        record = record_of(
            series,
            found,
            kind=kind,
            protocol={"predict": vars(config), "seed": self.seed},
            data={
                "name": capture.path.name,
                "view_sets": len(view_sets),
                "anchors": [views.anchor for views in view_sets],
                "views": 1 + max(len(views.sources) for views in view_sets),
            },
            device=device,
        )
        write_record(self.out / f"{series.name}.json", record)
        draw_series(self.out / f"{series.name}.png", series, record.rows)
        print(f"{series.title}: {path}, {counted(len(view_sets), 'view set')}")
        for table in series_tables(series, record.rows):
            table_console().print(table)
        for row in record.rows:
            if row.get("note"):
                print(f"{row['weights']} {row['step']}: {row['note']}".strip())
