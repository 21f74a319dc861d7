"""Flags of depth that something else than the network measured."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from deltas_nets.errors import UserError
from deltas_nets.terminal import warn

if TYPE_CHECKING:
    from deltas_nets.captures.capture import Capture
    from deltas_nets.captures.measured import Measured
    from deltas_nets.predict.predictor import Predictor

MEASURED = "sensor_depth"
"""The setting of a run that is there where measured depth is."""
SENSOR, POINTS, HAND = 0.01, 0.02, 0.01
"""Standard deviations as shares of the depth, where the user states none."""


@dataclass(frozen=True)
class Measuring:
    """A command to which measured depth can be given."""

    sensor_depth: Annotated[Path | None, tyro.conf.arg(metavar="sensor|points|FILE")] = None
    """Measured depth joins what is triangulated: the depth images of the capture, its sparse
    points, or a file of lines ID X Y METRES. With --views 1 maps rest on it alone."""
    sensor_deviation: Annotated[float | None, tyro.conf.arg(metavar="SHARE")] = None
    """Its standard deviation as a share of the depth: 0.01 if not given, 0.02 of sparse points."""

    def measured(self, capture: "Capture") -> "Measured | None":
        """Where measured depth comes from.

        Raises:
            UserError: the capture has none, or the file is malformed.
        """
        from deltas_nets.captures.measured import (
            ByHand,
            OfPoints,
            OfSensor,
            doubtful_unit,
            measured_by_hand,
        )

        name, deviation = str(self.sensor_depth), self.sensor_deviation
        if self.sensor_depth is None:
            if deviation is not None:
                what = "a deviation of what?"
                raise UserError(what, "--sensor-deviation", "add --sensor-depth")
            return None
        if name == "sensor" and not any(capture.frames.arrays.depths):
            what = "the capture has no sensor depth"
            raise UserError(what, capture.path, "leave out --sensor-depth")
        if name != "points" and not capture.metric:
            what = "measured depth is in metres, and the capture is in a unit of its own"
            raise UserError(what, "--sensor-depth", f"add --scale-from {self.sensor_depth}")
        if name == "sensor":
            return OfSensor(capture, deviation or SENSOR)
        if name == "points":
            if capture.points is None:
                what = "the capture has no sparse points"
                raise UserError(what, capture.path, "leave out --sensor-depth")
            return OfPoints(capture, deviation or POINTS)
        rows = measured_by_hand(self.sensor_depth, capture)
        doubt = doubtful_unit(rows, capture)
        if doubt is not None:
            warn(f"{doubt} ({self.sensor_depth})")
        return ByHand(capture, rows, deviation or HAND)

    def check_measuring(self, predictor: "Predictor", capture: "Capture") -> None:
        """Whether the network hears measured depth, and a file of it is right, before any look.

        Raises:
            UserError: one is not so.
        """
        from deltas_nets.captures.measured import measured_by_hand

        if self.sensor_depth is not None:
            predictor.check_measured()
            if str(self.sensor_depth) not in ("sensor", "points"):
                measured_by_hand(self.sensor_depth, capture)

    def check_completes(self, measured: "Measured", capture: "Capture", anchors: list[str]) -> None:
        """Whether something is measured of all frames that are to be completed.

        Raises:
            UserError: names those of which nothing is.
        """
        from deltas_nets.captures.ids import ids_in_words

        position = {id: number for number, id in enumerate(capture.frames)}
        without = [id for id in anchors if not measured.has(position[id])]
        if without:
            what = f"nothing is measured of {ids_in_words(without)}"
            remedy = "name the others with --view-sets, or use --views 2 or more"
            raise UserError(what, "--sensor-depth", remedy)

    def check_whole(self, capture: "Capture", anchors: list[str]) -> None:
        """Whether the depth images that will be read are whole, before anything is written.

        Raises:
            UserError: names the first that is not.
        """
        if str(self.sensor_depth) != "sensor":
            return
        for frame in map(capture.frame, anchors):
            if frame.depth_path is not None:
                frame.check_depth()

    def measured_record(self) -> dict[str, Any]:
        """What the results depend on, for the record of a run; nothing where nothing is asked."""
        if self.sensor_depth is None:
            return {}
        file = self.sensor_depth if self.sensor_depth.is_file() else None
        content = {} if file is None else {"lines": file.read_text("utf-8").splitlines()}
        given = {"from": str(self.sensor_depth), "deviation": self.sensor_deviation}
        return {MEASURED: given | content}
