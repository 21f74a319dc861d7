"""The command `deltas ablate`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from deltas_nets.commands.series import MeasuredSeries
from deltas_nets.outputs.alone import Written

Table = Literal[
    "points", "ratio", "nms", "threshold", "samples", "offsets", "architecture", "sparse"
]


@dataclass(frozen=True)
class Ablate(MeasuredSeries):
    """Change one setting of a trained network: the tables of the paper's supplement, on a capture.

    points: 0 to 768, and sensor depth at 512. ratio: detected of all points. nms: radius of
    suppression. threshold: of the detector. samples: along a segment. offsets: lines beside the
    epipolar line. architecture: each of --weights as it is. sparse: COLMAP's points. A network that
    lacks a setting has a row that says so. Trainings with one thing changed are in
    benchmarks/ablations.py.

    Example: deltas ablate points my_capture --out ablations
    """

    table: Annotated[tyro.conf.Positional[Table], tyro.conf.arg(metavar="TABLE")] = field(
        kw_only=True
    )
    """Which one."""
    capture: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CAPTURE")] = field(
        kw_only=True
    )
    """Folder with images, poses, intrinsics and depth/N.png."""

    @property
    def written(self) -> Written:
        """What no other run may write meanwhile."""
        return Written(self.out, "series", self.table)

    def run(self) -> None:
        """Run the command."""
        from deltas_nets.ablations.tables import TABLES

        self.measured(TABLES[self.table], self.capture, kind="ablation", num_views=3)
