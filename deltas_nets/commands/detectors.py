"""The command `deltas detectors`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import tyro

from deltas_nets.commands.command import Command
from deltas_nets.commands.flags import Flag, sensible
from deltas_nets.commands.values import at_least_one, not_empty, not_negative, positive
from deltas_nets.terminal import counted, progress, table_console, warn

if TYPE_CHECKING:
    from deltas_nets.evaluate.detectors.config import TableConfig


@dataclass(frozen=True)
class Detectors(Command):
    """Score interest points and descriptors: table 1 of the paper, on a capture with sensor depth.

    Every anchor of the view sets is compared with each of its sources. MLE: mean distance of a
    repeated point from its true place. MScore: correct matches of the points that both views see.
    Num: points in an image. Rep: points that are found in the other view too; 1:1, each with a
    partner of its own. rot and trans: pairs whose pose by PnP is right.

    Example: deltas detectors my_capture --detectors orb sift ours aliked=aliked-n16.pth
    """

    capture: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CAPTURE")]
    """Folder with images, poses, intrinsics and depth/N.png; or a text file of image pairs without
    depth, as SuperGlue's evaluation has them, for rotations and directions alone."""
    detectors: tuple[str, ...] = ("orb", "sift", "ours")
    """orb, sift, ours, spread (chance); with weights: ours=FILE (of deltas train, or the published
    checkpoint), superpoint=FILE, aliked=FILE, disk=FILE, xfeat=FILE."""
    view_sets: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """JSON: [{"anchor": 10, "sources": [8, 12]}, ...]; chosen if not given."""
    views: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Views of a set, the anchor included."""
    sets: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """So many view sets, spread over all; every one if not given."""
    num_points: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """The strongest N of every image and detector; if not given, those above each detector's own
    threshold, as in the paper."""
    nms_radius: int = 3
    """No point is so near to a stronger one, pixels (the paper: 3)."""
    tolerance: float = 3.0
    """Farthest that a repeated point or a correct match may be from its true place, pixels."""
    work_size: Annotated[tuple[int, int] | None, tyro.conf.arg(metavar="HEIGHT WIDTH")] = None
    """Of the images; their shape with about 240 x 320 pixels (the paper) if not given."""
    seed: int = 0
    """Of the samples that poses are found by."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Also write the table, and what made it, to this file."""
    debug: Flag = False
    """Show the traceback of an error."""

    checks: ClassVar = {
        "detectors": not_empty,
        "sets": at_least_one,
        "num_points": at_least_one,
        "nms_radius": not_negative,
        "seed": not_negative,
        "tolerance": positive,
    }

    def run(self) -> None:
        """Run the command."""
        from deltas_nets.captures.opening import looks_like_capture
        from deltas_nets.outputs.atomic_files import check_file

        if self.json is not None:
            check_file(self.json)
        if self.capture.is_file() and not looks_like_capture(self.capture):
            self._of_pairs()
        else:
            self._of_capture()

    def _config(self) -> "TableConfig":
        from deltas_nets.evaluate.detectors.config import TableConfig
        from deltas_nets.evaluate.detectors.features import DetectionConfig
        from deltas_nets.evaluate.detectors.pose.consensus import ConsensusConfig

        return sensible(
            TableConfig,
            detection=DetectionConfig(self.nms_radius, self.num_points),
            tolerance=self.tolerance,
            pnp=sensible(ConsensusConfig, seed=self.seed),
            essential=sensible(ConsensusConfig, threshold=1.0, seed=self.seed),
            work_size=self.work_size,
        )

    def _of_capture(self) -> None:
        from deltas_nets.captures.opening import open_capture
        from deltas_nets.captures.usable import check_all, usable_view_sets
        from deltas_nets.evaluate.detectors.capture import pairs_of, score_capture
        from deltas_nets.evaluate.detectors.registry import load_extractors
        from deltas_nets.evaluate.detectors.report import (
            detector_rows,
            detector_table,
            record_of,
        )
        from deltas_nets.evaluate.record import write_record
        from deltas_nets.evaluate.some_sets import evenly_spaced

        config, extractors = self._config(), load_extractors(self.detectors)
        capture = open_capture(self.capture)
        usable = usable_view_sets(capture, self.view_sets, self.views).view_sets
        view_sets = tuple(evenly_spaced(usable, self.sets))
        pairs = pairs_of(capture, view_sets)
        check_all(capture, view_sets)
        with progress("detectors", len(pairs)) as report:
            scores = score_capture(extractors, capture, pairs, config, report=report)
        if not capture.metric:
            warn("the capture states no metres: what is within 5 cm is not known")
            scores = {name: found.without_lengths() for name, found in scores.items()}
        if self.json is not None:
            data = {"name": capture.path.name, "view_sets": len(view_sets), "pairs": len(pairs)}
            rows = detector_rows(scores)
            write_record(self.json, record_of("detectors", rows, extractors, config, data))
        title = (
            f"{self.capture}: {counted(len(pairs), 'pair')} of {counted(len(view_sets), 'anchor')}"
        )
        table_console().print(detector_table(scores, title=title))

    def _of_pairs(self) -> None:
        from deltas_nets.evaluate.detectors.pairs_file import read_pairs, score_pairs
        from deltas_nets.evaluate.detectors.registry import load_extractors
        from deltas_nets.evaluate.detectors.report import record_of, relative_rows, relative_table
        from deltas_nets.evaluate.record import write_record
        from deltas_nets.evaluate.some_sets import evenly_spaced

        config, extractors = self._config(), load_extractors(self.detectors)
        pairs = evenly_spaced(read_pairs(self.capture), self.sets)
        with progress("detectors", len(pairs)) as report:
            scores = score_pairs(extractors, pairs, config, report=report)
        if self.json is not None:
            data = {"name": f"{self.capture.parent.name}/{self.capture.name}", "pairs": len(pairs)}
            rows = relative_rows(scores)
            write_record(self.json, record_of("relative poses", rows, extractors, config, data))
        title = f"{self.capture}: {counted(len(pairs), 'pair')}"
        table_console().print(relative_table(scores, title=title))
