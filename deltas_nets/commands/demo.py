"""The command `deltas demo`."""

from dataclasses import dataclass
from pathlib import Path

from deltas_nets.commands.flags import Flag, Prediction
from deltas_nets.outputs.alone import Written


@dataclass(frozen=True)
class Demo(Prediction):
    """Depth of a real stereo pair, with its errors: does everything work here?

    Runs the shipped weights on the Middlebury motorcycle pair that scikit-image carries,
    prints errors and times, and writes depth, confidence, points and a figure.

    Example: deltas demo --out demo
    """

    out: Path = Path("deltas-demo")
    """Folder to write to."""
    overwrite: Flag = False
    """Write into a folder that holds other things."""

    @property
    def written(self) -> Written:
        """What no other run may write meanwhile."""
        return Written(self.out, "depth")

    def run(self) -> None:
        """Run the command."""
        from deltas_nets.evaluate.demo import run_demo

        what = "the demo draws stages that the reference network does not have"
        model = self.predictor().deltas(what, self.weights, "use deltas depth")
        run_demo(model, self.config(), self.out, self.weights, overwrite=self.overwrite)
