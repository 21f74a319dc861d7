"""The command `deltas robustness`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from deltas_nets.commands.series import MeasuredSeries
from deltas_nets.outputs.alone import Written

Curve = Literal[
    "translation",
    "rotation",
    "calibration",
    "blur",
    "exposure",
    "views",
    "order",
    "units",
    "depth-range",
]


@dataclass(frozen=True)
class Robustness(MeasuredSeries):
    """How depth suffers from what is wrong with a capture: a curve, step by step.

    translation, rotation: cameras moved by 0 to 5 cm, turned by 0 to 2 degrees. calibration: focal
    length wrong by up to 5 %. blur, exposure: of images. views: 2 to 8. order: of the sources.
    units: of the world. depth-range: that is searched. Depth is scored against the capture as it
    is.

    Example: deltas robustness translation my_capture --out robustness
    """

    curve: Annotated[tyro.conf.Positional[Curve], tyro.conf.arg(metavar="CURVE")] = field(
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
        return Written(self.out, "series", self.curve)

    def run(self) -> None:
        """Run the command."""
        from deltas_nets.ablations.curves import MOST_VIEWS, curve

        views = MOST_VIEWS if self.curve == "views" else 3
        series = curve(self.curve, self.seed)
        self.measured(series, self.capture, kind="robustness", num_views=views)
