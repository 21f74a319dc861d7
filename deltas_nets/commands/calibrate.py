"""The command `deltas calibrate`: the last step before weights are used."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from deltas_nets.commands.command import Command
from deltas_nets.commands.flags import Flag
from deltas_nets.errors import UserError
from deltas_nets.extras import usable_device
from deltas_nets.terminal import counted, progress, table_console


@dataclass(frozen=True)
class Calibrate(Command):
    """Make the standard deviations that weights predict as large as their errors.

    Fits curves of eight points, one each for 2, 3, 5 and 8 views, on procedural rooms that no
    training sees, shows what they do on others, and writes the weights with them; depth stays the
    same.

    Example: deltas calibrate --weights runs/first/weights.safetensors --out mine.safetensors
    """

    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """Weights file to write, .safetensors."""
    weights: str = "deltas-small"
    """A shipped network, or a weights file of `deltas train`."""
    rooms: int = 100
    """Rooms to fit each curve on, at most 500; half as many are reported on. Errors of a room's
    pixels go together: with 60 rooms ratios are known to a tenth or a fifth only."""
    views: int = 3
    """Views of the rooms that are reported on, the anchor included."""
    size: Annotated[tuple[int, int], tyro.conf.arg(metavar="HEIGHT WIDTH")] = (288, 384)
    """Of their images: the one that the weights will work at, for standard deviations change with
    it."""
    depth_range: Annotated[tuple[float, float], tyro.conf.arg(metavar="NEAR FAR")] = (0.5, 10.0)
    """Nearest and farthest depth searched, metres."""
    device: str = "auto"
    """Where to compute: auto, cpu, cuda, cuda:1, mps."""
    overwrite: Flag = False
    """Replace --out if it exists."""
    debug: Flag = False
    """Show the traceback of an error."""

    def run(self) -> None:
        """Run the command."""
        from deltas_nets.evaluate.calibration import CalibrationMeter
        from deltas_nets.evaluate.fit_calibration import fit_calibration
        from deltas_nets.evaluate.report import calibration_table, sparsification_line
        from deltas_nets.evaluate.rooms import (
            CALIBRATION_SEEDS,
            EVALUATION_SEEDS,
            held_out_rooms,
            measure_rooms,
        )
        from deltas_nets.network.lite.calibration import VIEWS
        from deltas_nets.weights_file import (
            check_new_weights,
            load_model,
            read_metadata,
            save_weights,
            weights_file,
        )

        check_new_weights(self.out, overwrite=self.overwrite)
        self._check()
        model = load_model(self.weights, usable_device(self.device))
        metadata = read_metadata(weights_file(self.weights))
        held_out = held_out_rooms(
            max(1, self.rooms // 2), EVALUATION_SEEDS, num_views=self.views, image_size=self.size
        )
        fitted_on = {
            views: held_out_rooms(
                self.rooms, CALIBRATION_SEEDS, num_views=views, image_size=self.size
            )
            for views in VIEWS
        }
        with progress("calibrate", len(VIEWS) * self.rooms + 3 * len(held_out)) as report:
            shown = []  # rendered once
            for number in range(len(held_out)):
                shown.append(held_out[number])
                report(str(number))
            before, after = CalibrationMeter(), CalibrationMeter()
            measure_rooms(model, shown, before, depth_range=self.depth_range, report=report)
            fit_calibration(model, fitted_on, depth_range=self.depth_range, report=report)
            measure_rooms(model, shown, after, depth_range=self.depth_range, report=report)
        first, size = CALIBRATION_SEEDS.start, "x".join(map(str, self.size))
        counts = ", ".join(map(str, VIEWS))
        said = f"procedural rooms {first}..{first + self.rooms}, {counts} views, {size}"
        # Before the reader of what is printed may have had enough.
        save_weights(self.out, model, metadata | {"calibration": said})
        found, console = counted(len(shown), "other room"), table_console()
        console.print(calibration_table(before.result(), title=f"{found}, before"))
        console.print(calibration_table(after.result(), title=f"{found}, after"))
        print(sparsification_line(after.result()))
        print(f"weights in {self.out}")

    def _check(self) -> None:
        if not 2 <= self.rooms <= 500:
            raise UserError(f"no {self.rooms} rooms", "--rooms", "give 2 to 500")
        if not 2 <= self.views <= 12:
            raise UserError(f"no rooms of {self.views} views", "--views", "give 2 to 12")
